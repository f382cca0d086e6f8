"""Dashboards get settings, names, series, pictures and the final table;
read back from what they wrote.
"""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from campaigns import brief, spectra
from doors import knock
from PIL import Image

from gsparc.commands.train import main
from gsparc.field.optimizer import OptimizerSettings
from gsparc.training.tracking import (
    PartLogger,
    log_picture,
    log_table,
    tensorboard_logger,
    wandb_logger,
)

BLOCK, HEAD, START = 32768, 7, 7  # bytes


@dataclass
class Offline:
    """A run as the service would show it."""

    name: str = ""
    group: str = ""
    tags: list[str] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)

    def series(self, key: str) -> list[tuple[int, Any]]:
        """Steps and values."""
        return [(row["trainer/global_step"], row[key]) for row in self.rows if key in row]


def records(path: Path) -> Iterator[bytes]:
    content, at, whole = path.read_bytes(), START, b""
    while at + HEAD <= len(content):
        if BLOCK - at % BLOCK < HEAD:
            at += BLOCK - at % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + HEAD])
        whole += content[at + HEAD : at + HEAD + length]
        at += HEAD + length
        if kind in (1, 4):  # whole, or the last part
            yield whole
            whole = b""


def offline_run(folder: Path) -> Offline:
    """Of the only one in a run's folder."""
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    run = Offline()
    for one in records(file):
        record = Record()
        record.ParseFromString(one)
        kind = record.WhichOneof("record_type")
        if kind == "run" and record.run.display_name:
            run.name, run.group, run.tags = (
                record.run.display_name,
                record.run.run_group,
                [*record.run.tags],
            )
        if kind == "config":
            run.config |= {item.key: json.loads(item.value_json) for item in record.config.update}
        if kind == "history":
            items = {
                item.key or ".".join(item.nested_key): json.loads(item.value_json)
                for item in record.history.item
            }
            run.rows.append(items)
    return run


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


def rises(steps) -> bool:
    return len(steps) > 0 and list(steps) == sorted(set(steps))


@pytest.mark.slow
def test_dashboards_knew_neither_settings_nor_name_nor_sweep_and_a_refit_began_its_series_again(
    sweep,
):
    for folder, (job, count) in zip(sweep, COUNTS.items(), strict=True):
        run = offline_run(folder)
        assert (run.name, run.group) == (f"{job} model.field.count={count}", "swept")
        assert run.tags == ["own", "random", "gsparc"]
        model, trainer = run.config["model"], run.config["trainer"]
        assert model["field"]["count"] == count and trainer["max_steps"] == 20
        assert model["optimizer"]["positions"] == 1e-3
        for key in ("train/loss", "refit/train/loss", "val/psnr_db"):
            assert rises([step for step, _ in run.series(key)]), key
        told = {key for row in run.rows for key in row}
        rates = {key.removeprefix("rate/") for key in told if key.startswith("rate/")}
        assert (
            {"positions", "emission"}
            < rates
            <= {setting.name for setting in fields(OptimizerSettings)}
        )
        assert {"final/test/psnr_db", "test rows.filenames", "results.path"} <= told
        settings = yaml.safe_load((folder / "csv" / "version_0" / "hparams.yaml").read_text())
        assert settings["model"]["field"]["count"] == count and settings["seed"] == 0
        rows = pd.read_csv(folder / "csv" / "version_0" / "metrics.csv")
        for key in ("train/loss", "refit/train/loss", "val/psnr_db", "refit/rate/positions"):
            assert rises(rows.step[rows[key].notna()]), key
        assert rows["final/test/psnr_db"].notna().sum() == 1
        if find_spec("tensorboard"):
            assert_on_tensorboard(folder / "tensorboard", count)


def assert_on_tensorboard(folder: Path, count: int) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    found = EventAccumulator(str(folder)).Reload()
    for key in ("train/loss", "refit/train/loss", "val/psnr_db"):
        assert rises([one.step for one in found.Scalars(key)]), key
    (content,) = found.PluginTagToContent("hparams").keys() & {"_hparams_/session_start_info"}
    told = HParamsPluginData.FromString(
        found.PluginTagToContent("hparams")[content]
    ).session_start_info.hparams
    assert told["model/field/count"].number_value == count and told["seed"].number_value == 0
    assert len(found.Scalars("final/test/psnr_db")) == 1
    assert found.Images("test rows")
    assert b"gsparc" in found.Tensors("results/text_summary")[0].tensor_proto.string_val[0]
