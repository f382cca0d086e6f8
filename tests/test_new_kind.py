"""A fourth kind of measurement, added in the files that CONTRIBUTING.md names and nowhere else."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import gsparc
from gsparc.__main__ import main
from gsparc.data import fields, target
from gsparc.data.target import Target
from gsparc.evaluation import metric_formats
from gsparc.evaluation.metrics import SampleMetric
from tests.helpers.doors import knock


class Angles(Target):
    """Angles of arrival (paths,) [rad], one number a path."""

    kind: Any = "angles"
    called, arrays = "sets of angles", ("angles",)
    numbers, axes = 2, 2

    def scale(self, values: np.ndarray, mask: np.ndarray | None) -> float:
        return 1.0

    def describe(self, count: int, shape: tuple[int, ...]) -> str:
        return f"{count} rows of the angles of {shape[0]} paths"

    def to_real(self, target: np.ndarray) -> np.ndarray:
        rows = super().to_real(target)
        return np.stack([np.cos(rows), np.sin(rows)], axis=-1).reshape(len(rows), -1)

    def to_targets(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        points = rows.reshape(len(rows), *shape, 2)
        return torch.atan2(points[..., 1], points[..., 0])

    def entry_variance(self, variance: Tensor, mean: Tensor) -> Tensor:
        return variance


class AngleMetrics(SampleMetric):
    """Distances on the circle [degrees]."""

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        error = (torch.remainder(prediction - target + torch.pi, 2 * torch.pi) - torch.pi).double()
        return {
            "error_deg": error.abs().rad2deg().mean(1),
            "mse": error.square().mean(1),
            "mae": error.abs().mean(1),
            "target_power": torch.ones(len(error)),
        }

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        return {
            "error_deg": float(samples["error_deg"].mean()),
            "samples": len(samples["error_deg"]),
        }


@pytest.fixture
def angles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of angles of four paths, which the program has been told of."""
    monkeypatch.chdir(tmp_path)
    kind, figures = Angles(), ("error_deg",)
    field = replace(fields.FIELDS["csi"], name="angles", shape="(S, P)", unit="rad", also="")
    monkeypatch.setitem(target.TARGETS, kind.kind, kind)
    monkeypatch.setitem(target.MEASUREMENTS, "angles", kind)
    monkeypatch.setitem(fields.FIELDS, "angles", replace(field, holds="real numbers"))
    shown = metric_formats.KindFigures(
        AngleMetrics, figures, "error_deg", "error_deg", figures, figures, figures
    )
    monkeypatch.setitem(metric_formats.OF_KIND, kind.kind, shown)
    monkeypatch.setitem(metric_formats.DECIDING, kind.kind, "error_deg")
    figure = metric_formats.Figure("mean error, degrees", ".2f", "ratio")
    monkeypatch.setitem(metric_formats.FIGURES, "error_deg", figure)
    tx = np.random.default_rng(0).uniform((0, 0, 1), (8, 6, 2), (120, 3))
    mirrored = np.stack([tx, tx * [-1, 1, 1], tx * [1, -1, 1], [16, 0, 0] - tx * [1, -1, -1]], 1)
    offset = mirrored - [1.0, 1.0, 2.0]
    path = tmp_path / "angles.npz"
    seen = np.arctan2(offset[..., 1], offset[..., 0])
    np.savez(path, tx_position=tx, rx_position=[1.0, 1.0, 2.0], angles=seen)
    return path


def test_a_fourth_kind_is_read_learned_scored_and_asked(angles: Path, tmp_path: Path) -> None:
    """No part of the program takes it for another kind."""

    def say(*words: str) -> list[str]:
        answer = knock(main, "gsparc", words)
        assert answer.status == 0, answer
        return answer.out

    run, places = tmp_path / "run", tmp_path / "places.csv"
    assert say("check", str(angles))[-1].endswith(": good")
    of_run = "dataset=own", f"dataset.file={angles}", "model=gp", f"hydra.run.dir={run}"
    say("train", *of_run, "logger=none", "threads=1")
    tested = gsparc.load(run / "model.ckpt")
    assert tested.site.kind == "angles"
    with np.load(angles) as stored:
        tx, seen = stored["tx_position"], stored["angles"]
    error = tested.predict(tx=tx).mean.numpy() - seen
    circle = np.abs((error + np.pi) % (2 * np.pi) - np.pi)
    assert np.rad2deg(circle).mean() < 2
    call = tested.cycle_places(tested.site.local_places({"tx": tx}))
    assert np.allclose(call(3), tested.predict(tx=tx[3]).mean[0])
    places.write_text("x,y,z\n1.5,2,1.5\n3,4,1.5\n")
    out = tmp_path / "told.csv"
    say("predict", f"ckpt={run / 'model.ckpt'}", f"places={places}", f"out={out}")
    with out.open(newline="") as file:
        heads = csv.DictReader(file).fieldnames or []
    assert [head for head in heads if head.startswith("angles")][1:] == [
        f"angles_{path}" for path in range(4)
    ]
    say(
        "evaluate",
        f"ckpt={run / 'model.ckpt'}",
        f"hydra.run.dir={tmp_path / 'evaluated'}",
        "threads=1",
    )


def test_a_fourth_kind_without_a_compiled_form_is_refused(angles: Path, tmp_path: Path) -> None:
    """An assertion is no answer."""
    run = tmp_path / "run"
    of_run = "dataset=own", f"dataset.file={angles}", "model=gp", f"hydra.run.dir={run}"
    assert knock(main, "gsparc", ["train", *of_run, "logger=none", "baselines=[]"]).status == 0
    answer = knock(
        main, "gsparc", ["export", f"ckpt={run / 'model.ckpt'}", "to=c", f"out={tmp_path / 'm.c'}"]
    )
    assert answer.status == 1 and "sets of angles have no compiled form" in answer.err[-1], answer
