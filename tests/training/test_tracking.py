"""Dashboards get settings, names, series, pictures and the final table;
read back from what they wrote.
"""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from campaigns import brief, spectra
from doors import knock
from PIL import Image

from gsparc.commands.train import main
from gsparc.training.tracking import (
    PartLogger,
    log_picture,
    log_table,
    tensorboard_logger,
    wandb_logger,
)

COUNTS = {0: 40, 1: 30}  # of Gaussians, in the jobs of the sweep


class Records:
    """A logger of Weights & Biases as far as we speak to it."""

    def __init__(self):
        self.said = []

    def log_image(self, name, images, step):
        self.said.append((name, images, step))

    def log_table(self, name, columns, data):
        self.said.append((name, columns, data))


@pytest.fixture
def file(tmp_path):
    Image.fromarray(np.full((4, 6, 3), 90, np.uint8)).save(tmp_path / "a.png")
    return tmp_path / "a.png"


def test_weights_and_biases_gets_files_and_tables(file):
    logger = Records()
    log_picture([logger], "predictions", file, 7)
    log_table([logger], "results", ["method", "dB"], [["gp", "3.1"]])
    assert logger.said == [
        ("predictions", [str(file)], 7),
        ("results", ["method", "dB"], [["gp", "3.1"]]),
    ]


def test_tensorboard_gets_pixels_and_markdown(file, tmp_path):
    pytest.importorskip("tensorboard", reason="TensorBoard is not installed: the extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = tensorboard_logger(str(tmp_path))
    log_picture([logger], "predictions", file, 7)
    log_table([logger], "results", ["method", "dB"], [["gp", "3.1"]])
    logger.finalize("success")
    found = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    (image,) = found.Images("predictions")
    assert (image.step, image.height, image.width) == (7, 4, 6)
    (text,) = found.Tensors("results/text_summary")
    assert b"| gp | 3.1 |" in text.tensor_proto.string_val[0]


def test_other_loggers_are_left_alone(file):
    logger = type("CSV", (), {"experiment": object()})()
    log_picture([logger], "predictions", file, 7)
    log_table([logger], "results", ["method"], [["gp"]])
    assert not vars(logger)


def test_a_part_has_pictures_and_figures_under_its_name(file):
    logger = Records()
    logger.log_metrics = lambda figures, step: logger.said.append((figures, step))
    part = PartLogger(PartLogger(logger, "fold1"), "refit")
    part.log_metrics({"train/loss": 0.5}, 9)
    log_picture([part], "predictions", file, 7)
    assert logger.said == [
        ({"fold1/refit/train/loss": 0.5}, 9),
        ("fold1/refit/predictions", [str(file)], 7),
    ]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory) -> list[Path]:
    """Folders of two jobs with a refit each, told to all dashboards."""
    folder = tmp_path_factory.mktemp("told")
    board = (
        "{_target_: gsparc.training.tracking.tensorboard_logger, save_dir: "
        "'${hydra:runtime.output_dir}'}"
    )
    words = [word for word in brief(spectra(folder / "own.npz")) if word != "logger=none"]
    words += ["logger=wandb", "logger.wandb.offline=true", "~hydra.callbacks.sweep"]
    words += [f"+logger.tensorboard={board}"] if find_spec("tensorboard") else []
    words += [
        f"model.field.count={','.join(map(str, COUNTS.values()))}",
        f"hydra.sweep.dir={folder / 'swept'}",
    ]
    assert knock(main, "train.py", ["-m", *words]).status == 0
    return sorted(file.parent for file in (folder / "swept").glob("*/summary.json"))


@pytest.mark.parametrize("offline", [None, True, False])
def test_the_environment_s_mode_of_wandb_was_overridden_by_the_configuration(offline, monkeypatch):
    said, logger = {}, SimpleNamespace(_wandb_init={"anonymous": None})

    def made(**settings):
        said.update(settings)
        return logger

    monkeypatch.setattr("lightning.pytorch.loggers.WandbLogger", made)
    monkeypatch.setenv("WANDB_MODE", "disabled")
    assert wandb_logger(offline) is logger and not logger._wandb_init
    assert said["mode"] == "disabled" and not said["offline"]


@pytest.mark.slow
def test_wandb_warned_of_what_the_program_itself_had_said(tmp_path):
    code = (
        "from gsparc.training.tracking import wandb_logger as w; "
        f"w(save_dir={str(tmp_path)!r}).experiment"
    )
    env = {name: value for name, value in os.environ.items() if not name.startswith("WANDB")}
    said = subprocess.run(
        [sys.executable, "-c", code],
        env={**env, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert said.returncode == 0 and "WARNING" not in said.stderr, said.stderr
