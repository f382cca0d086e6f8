from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from gsparc.callbacks import StepProgress, progress


@pytest.fixture
def screen(monkeypatch):
    """What a terminal of 80 columns would show."""
    console = Console(width=80, force_terminal=True, record=True, file=StringIO())
    made = progress.Progress
    monkeypatch.setattr(progress, "Progress", lambda *columns: made(*columns, console=console))
    return console


FIGURES = {"train/task_loss": 0.0123, "val/ssim_gauss": 0.9315, "val/psnr_db": 29.25}


def run(step: int = 400) -> tuple[SimpleNamespace, SimpleNamespace]:
    trainer = SimpleNamespace(
        max_steps=400, global_step=step, callback_metrics=FIGURES, is_global_zero=True
    )
    return trainer, SimpleNamespace(count=500, run_dir=Path("run"), pace=None)


def test_one_line_of_80_columns_says_how_far_and_how_good(screen):
    bar, (trainer, module) = StepProgress(), run()
    bar.on_train_start(trainer, module)
    bar.on_train_batch_end(trainer, module)
    bar.on_train_end(trainer, module)
    line = screen.export_text().strip().splitlines()[-1]
    for words in ("400/400", "loss 0.0123", "0.9315", "29.25 dB", "500 Gaussians"):
        assert words in line
    assert "…" not in line


def test_an_exception_gives_the_terminal_back(screen):
    bar, (trainer, module) = StepProgress(), run(3)
    bar.on_train_start(trainer, module)
    bar.on_exception(trainer, module, RuntimeError())
    bar.on_train_batch_end(trainer, module)  # nothing left to draw on
    assert bar._bar is None
