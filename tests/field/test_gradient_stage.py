import signal
from functools import partial

import lightning.pytorch as L
import pytest
import torch
from campaigns import spectra
from contexts import trained

from gsparc.callbacks import CostLedger, Densify
from gsparc.models import checkpoint
from gsparc.training import curve


class Interrupt(L.Callback):
    """Presses Ctrl-C in the middle of a step, `times` times."""

    def __init__(self, step: int, times: int = 1) -> None:
        self.step, self.times = step, times

    def on_train_batch_start(self, trainer, *unused):
        if trainer.global_step == self.step:
            for _ in range(self.times):
                signal.raise_signal(signal.SIGINT)


def run(tmp_path, *callbacks, steps: int = 20, overrides: tuple[str, ...] = (), **more):
    file, made = spectra(tmp_path / "own.npz"), {"callbacks": lambda: list(callbacks), "every": 5}
    return (
        trained(file, tmp_path / "run", steps, *overrides, **made, **more)[0]
        .fitted_model()
        .state_dict()
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nobody cut off, and its folder."""
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("whole")
    return run(folder, CostLedger()), folder


@pytest.mark.slow
def test_a_run_cut_off_where_a_solved_field_is_edited_could_not_go_on(tmp_path, monkeypatch):
    """The edit looked for the batch of the step before:
    so ended every run of rfid that was resumed.
    """
    torch.set_num_threads(1)
    asked = {"overrides": ("init=images",)}
    # Of so small a field any edit is more
    monkeypatch.setattr("gsparc.callbacks.densify.MOST_CHANGE", 1.0)
    edits = partial(Densify, start=5, stop=15, interval=5, grad_threshold=0.0, max_gaussians=44)
    whole = run(tmp_path, edits(), **asked)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Interrupt(10, times=2), edits(), **asked)
    resumed = run(tmp_path, edits(), resume=tmp_path / "run" / "last.ckpt", **asked)
    assert len(whole["gaussians.ids"]) > 40
    assert all(torch.equal(whole[key], resumed[key]) for key in whole)


@pytest.mark.slow
def test_a_look_that_was_due_where_a_run_was_cut_off_was_left_out(tmp_path):
    """Of the learning curve, and of what is kept;
    a checkpoint of step 10 was written before the look.
    """
    torch.set_num_threads(1)
    whole, folder = run(tmp_path, CostLedger(), validate_every=5), tmp_path / "run"
    rows = [row | {"seconds": ""} for row in curve.read_curve(folder)]
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, CostLedger(), Interrupt(10, times=2), validate_every=5)
    assert checkpoint.read(folder / "last.ckpt").extra["trainer"]["global_step"] == 10
    resumed = run(tmp_path, CostLedger(), resume=folder / "last.ckpt", validate_every=5)
    assert [row | {"seconds": ""} for row in curve.read_curve(folder)] == rows and len(rows) == 6
    assert all(torch.equal(whole[key], resumed[key]) for key in whole)


def test_a_run_that_went_on_did_not_say_so_nor_from_where(tmp_path, caplog):
    caplog.set_level("INFO")
    before, last = signal.getsignal(signal.SIGINT), tmp_path / "run" / "last.ckpt"
    with pytest.raises(KeyboardInterrupt, match=f"go on with ckpt_path={last}"):
        run(tmp_path, Interrupt(7))
    assert signal.getsignal(signal.SIGINT) is before
    assert "going on" not in caplog.text
    run(tmp_path, resume=last)
    assert f"gradient steps: going on after step 8 of 20, as {last} left them" in caplog.text


def test_a_checkpoint_with_every_step_done_still_ends_in_a_model(whole, tmp_path):
    """Killed between the last checkpoint and the model's file:
    Lightning then skips training and its end.
    """
    ledger = CostLedger()
    resumed = run(tmp_path, ledger, resume=whole[1] / "run" / "last.ckpt")
    assert all(torch.equal(value, resumed[key]) for key, value in whole[0].items())
    assert ledger.seconds > 0.0


class Watching(L.Callback):
    """Remembers the loss of every step and what a validation is told of it."""

    def __init__(self) -> None:
        self.steps: list[float] = []
        self.logged: dict[int, float] = {}

    def on_train_batch_start(self, trainer, module, *unused):
        if not self.steps:
            inner = module.task_loss

            def spied(*given):
                loss = inner(*given)
                if torch.is_grad_enabled():
                    self.steps.append(float(loss.detach().mean()))
                return loss

            module.task_loss = spied
            self.steps.append(float("nan"))

    def on_validation_start(self, trainer, module):
        if not trainer.sanity_checking:
            self.logged[trainer.global_step] = float(trainer.callback_metrics["train/task_loss"])


def test_a_learning_curve_has_the_loss_of_its_own_step(tmp_path):
    watching = Watching()
    run(tmp_path, watching, steps=21, validate_every=7)
    assert set(watching.logged) == {7, 14, 21}
    for step, loss in watching.logged.items():
        assert loss == pytest.approx(watching.steps[step], rel=1e-6)
