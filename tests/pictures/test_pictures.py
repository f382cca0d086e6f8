"""Every kind of target leaves a picture of its test rows; those of all methods stand in one."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsparc.data.splits import Fold
from gsparc.evaluation.examples import FILE, Examples
from gsparc.models.baselines.mean import Mean
from gsparc.models.registry import method_class
from gsparc.pictures import pictures
from gsparc.pictures.pictures import draw_points, draw_predictions
from gsparc.training.context import FitContext


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_test_rows_are_drawn(campaign, tmp_path, kind):
    data = campaign(kind)
    rows = np.arange(len(data))
    fold = Fold(rows[::2], rows[:0], rows[1::2])
    method = Mean()
    method.fit(data, fold, FitContext(tmp_path))
    shown = Examples.of_methods({"mean": method}, data, fold.test) if kind == "spectrum" else None
    draw_predictions(method, data, fold.test, shown, "title", tmp_path / "deep" / "test.png")
    with Image.open(tmp_path / "deep" / "test.png") as image:
        assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_levels_of_silent_rows_were_drawn_as_measured(campaign, tmp_path, monkeypatch):
    data = campaign("rssi")
    rows, drawn = np.arange(len(data)), []
    data = replace(data, censored=(rows % 4 == 1).astype(np.int8))
    monkeypatch.setattr(pictures, "draw_points", lambda target, *rest: drawn.append(target))
    fold, method = Fold(rows[::2], rows[:0], rows[1::2]), Mean()
    method.fit(data, fold, FitContext(tmp_path))
    draw_predictions(method, data, fold.test, None, "title", tmp_path / "test.png")
    assert len(drawn[0]) == len(rows[3::4])


def test_silent_channels_do_not_break_the_picture(tmp_path):
    target = np.zeros((5, 1, 1), np.complex64)
    target[0] = 1
    draw_points(target, target * 0.5, "title", tmp_path / "points.png")
    assert (tmp_path / "points.png").stat().st_size > 1000


@pytest.fixture
def kept(campaign, tmp_path):
    """What the nearest row and the mean say of some rows, as a run of the mean keeps it."""
    data, rows = campaign("spectrum"), np.arange(len(campaign("spectrum")))
    fold, methods = Fold(rows[::2], rows[:0], rows[1::2]), {}
    for name in ("nearest", "mean"):
        methods[name] = method_class(name)()
        methods[name].fit(data, fold, FitContext(tmp_path))
    return data, fold, Examples.of_methods(methods, data, fold.test)


def test_rows_are_spread_and_survive_the_file(kept, tmp_path):
    data, fold, found = kept
    found.write(tmp_path / FILE)
    again = Examples.read(tmp_path / FILE)
    assert {found.rows[0], found.rows[-1]} == {fold.test[0], fold.test[-1]} and len(found.rows) == 4
    assert np.array_equal(again.rows, found.rows) and [*again.predicted] == ["nearest", "mean"]
    assert np.abs(again.truth - data.targets(found.rows).numpy()).max() < 1e-3
    assert Examples.read(tmp_path / "none.npz") is None
