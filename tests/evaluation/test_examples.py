"""The same test rows of every method stand in one picture, with their figures."""

from dataclasses import replace

import numpy as np
import pytest

from gsparc.data.splits import Fold
from gsparc.evaluation.examples import FILE, Examples, join_examples
from gsparc.evaluation.pictures import draw_spectra
from gsparc.evaluation.results import Run, frame_of_runs
from gsparc.models.registry import method_class
from gsparc.training.context import FitContext


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


def test_runs_of_the_same_rows_share_a_picture(kept, tmp_path):
    _, _, found = kept
    runs = []
    others = replace(found, rows=found.rows + 1)
    for name, own in (("a", found), ("b", found), ("c", others)):
        (tmp_path / name).mkdir()
        own.write(tmp_path / name / FILE)
        facts = {"model/name": name, "baseline/nearest/psnr_db": 9.0, "split/sha256": "s", "seed": 0}
        runs.append(Run(tmp_path / name, facts | {"test/psnr_db": 9.0}))
    joined = join_examples(frame_of_runs(runs))
    assert [*joined.predicted] == ["nearest", "a", "b"]
    figure = draw_spectra(joined, "title")
    grid = np.array(figure.axes[:20]).reshape(4, 5)
    assert [axis.get_title() for axis in grid[0]] == ["measured", "nearest", "a", "b", "b - measured"]
    assert all("dB, SSIM" in axis.get_xlabel() for axis in grid[:, 1:4].flat)
    scales = {image.get_clim() for axis in grid[:, :4].flat for image in axis.images}
    assert scales == {(0, 1)}, "one colour scale"
