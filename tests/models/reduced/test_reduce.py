"""Each kind of model spares what it says, stays near itself when little is spared, and is left as it was."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from boxes import room_of_spectra
from campaigns import brief, channels, compose

from gsparc.commands.train import train
from gsparc.data.load import load
from gsparc.data.splits import Fold
from gsparc.field.gaussians import FieldSettings
from gsparc.models import reduced
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.moving_array.method import MovingArrayField
from gsparc.models.moving_array.triangulate import SearchSettings
from gsparc.models.splat import reduce as field_reduce
from gsparc.models.splat.array import ArrayField
from gsparc.training.context import FitContext


def answer(method, data, rows):
    batch = data.batch(rows)
    return method.predict(batch.tx, batch.rx)


def away(method, other, data, rows) -> float:
    """Relative squared distance of two methods' answers."""
    a, b = answer(method, data, rows).mean, answer(other, data, rows).mean
    return float((a - b).abs().square().sum() / a.abs().square().sum())


def test_a_splatted_field_with_fewer_gaussians_is_taught_and_left_as_it_was(field):
    method, data, fold = field.methods[0], field.data, field.split.folds[0]
    before = answer(method, data, fold.test).mean.clone()
    measured = reduced.contributions(method, data, fold.train)
    assert measured["contribution"].shape == (40,) and (measured["contribution"] >= 0).all()
    assert away(method, reduced.reduced(method, {"keep": 1.0}, measured), data, fold.test) < 1e-3
    half, few = (reduced.reduced(method, {"keep": share}, measured) for share in (0.5, 0.1))
    assert half.size() == 20 and few.size() == 4 and method.size() == 40
    assert away(method, half, data, fold.test) < 0.2 < away(method, few, data, fold.test)
    assert torch.equal(answer(method, data, fold.test).mean, before)


def test_the_order_of_keeping_is_spread_over_the_sky(field):
    method, fold = field.methods[0], field.split.folds[0]
    measured = reduced.contributions(method, field.data, fold.train)
    order = field_reduce.spread(method.fitted(), measured)
    assert sorted(order.tolist()) == list(range(40)) and order[0] == measured["contribution"].argmax()
    seen = torch.nn.functional.normalize(method.fitted().gaussians.means - measured["receiver"][0], dim=1)

    def nearest(rows):
        apart = torch.cdist(seen[rows], seen[rows])
        return float((apart + 9 * torch.eye(len(rows))).min())

    assert nearest(order[:8]) > 1.3 * nearest(torch.arange(8))


@pytest.mark.parametrize(
    ("settings", "near"),
    [
        ({"stride": 2}, 0.1),
        ({"projection": "equirect"}, 0.5),
    ],
)
def test_what_a_splatted_field_spares_stays_near_it(field, settings, near):
    method, data, fold = field.methods[0], field.data, field.split.folds[0]
    lean = reduced.reduced(method, settings, reduced.contributions(method, data, fold.train))
    found = answer(lean, data, fold.test).mean
    assert found.shape == data.batch(fold.test).target.shape
    assert away(method, lean, data, fold.test) < near


def test_confidence_that_is_spared_is_not_computed(field):
    method, data, fold = field.methods[0], field.data, field.split.folds[0]
    lean = reduced.reduced(method, {"confidence": False}, reduced.contributions(method, data, fold.train))
    assert answer(lean, data, fold.test).confidence is None
    assert answer(method, data, fold.test).confidence is not None
    assert away(method, lean, data, fold.test) == 0


@pytest.fixture(scope="module")
def through_array(tmp_path_factory):
    data = load({"name": "rfid_sim", "count": 48, "root": str(tmp_path_factory.mktemp("sim")), "seed": 0})
    method = ArrayField(FieldSettings(count=64))
    rows = np.arange(48)
    fold = Fold(rows[rows % 4 > 0], rows[:0], rows[::4])
    method.fit(data, fold, FitContext(tmp_path_factory.mktemp("run")))
    return method, data, fold


def test_fewer_places_say_what_all_of_them_said(through_array):
    method, data, fold = through_array
    assert reduced.knobs(method) == ("keep", "stride", "confidence")
    measured = reduced.contributions(method, data, fold.train)
    ways = [reduced.reduced(method, {"keep": share}, measured) for share in (1.0, 0.75, 0.1)]
    assert [way.fitted().emission.encoding.width for way in ways] == [36, 27, 4]
    assert method.fitted().emission.encoding.width == 36
    error = [away(method, way, data, fold.test) for way in ways]
    assert error[0] < 1e-5 < error[1] < error[2]
    unsure = [float(answer(way, data, fold.train).confidence.mean()) for way in ways]
    assert unsure[0] > unsure[1] > unsure[2]


def test_an_array_spares_pixels_and_its_confidence(through_array):
    method, data, fold = through_array
    measured = reduced.contributions(method, data, fold.train)
    coarse = reduced.reduced(method, {"stride": 3, "confidence": False}, measured)
    assert away(method, coarse, data, fold.test) < 0.05 and answer(coarse, data, fold.test).confidence is None
    wide = answer(reduced.reduced(method, {"stride": 2}, measured), data, fold.test)
    whole = answer(method, data, fold.test)
    torch.testing.assert_close(wide.mean[:, ::2, ::2], whole.mean[:, ::2, ::2], atol=1e-5, rtol=1e-4)
    assert torch.equal(wide.confidence, whole.confidence) and torch.equal(wide.variance, whole.variance)


def test_a_process_of_sources_spares_searches_sources_and_its_variance(tmp_path):
    data = load({"name": "own", "file": str(channels(tmp_path / "own.npz", rows=60, shape="S"))})
    rows = np.arange(60)
    fold = Fold(rows[rows % 3 > 0], rows[:0], rows[::3])
    method = ImageSourceGP(searches=2, budget_s=4, search_rows=40, max_sources=4)
    method.fit(data, fold, FitContext(tmp_path))
    measured = reduced.contributions(method, data, fold.train)
    silent = reduced.reduced(method, {"confidence": False}, measured)
    assert away(method, silent, data, fold.test) < 1e-9 and answer(silent, data, fold.test).variance is None
    one = reduced.reduced(method, {"searches": 1}, measured)
    assert len(one.members) == 1 and answer(one, data, fold.test).variance is not None
    few = reduced.reduced(method, {"keep": 0.3}, measured)
    assert 1 <= few.size() <= method.size() and torch.isfinite(answer(few, data, fold.test).mean).all()


def test_a_gaussian_process_spares_components_pixels_and_its_variance(field):
    data, fold = field.data, field.split.folds[0]
    method = GaussianProcess()
    method.fit(data, fold, FitContext(Path()))
    whole = reduced.reduced(method, {"confidence": False}, {})
    assert away(method, whole, data, fold.test) < 1e-8 and answer(whole, data, fold.test).variance is None
    assert reduced.reduced(method, {"confidence": True}, {}) is method
    few = reduced.reduced(method, {"keep": 0.2, "stride": 2}, {})
    assert few.size() < len(method.axes) and 0 < away(method, few, data, fold.test) < 0.3


@pytest.fixture(scope="module")
def crossings(tmp_path_factory):
    data = room_of_spectra()
    rows = np.arange(len(data.target))
    fold = Fold(rows[rows % 4 > 0], rows[:0], rows[::4])
    method = MovingArrayField(
        SearchSettings(sources=17, rows=40, candidates=2000, steps=20), components=64, seed=0
    )
    method.fit(data, fold, FitContext(tmp_path_factory.mktemp("run")))
    return method, data, fold


def test_one_search_is_not_swept_as_two(crossings):
    method, trends = crossings[0], crossings[0].trends
    assert ("searches" in reduced.knobs(method)) == (len(trends) > 1)
    try:
        method.trends = trends[:1] * 2
        assert "searches" in reduced.knobs(method)
        method.trends = trends[:1]
        assert "searches" not in reduced.knobs(method)
    finally:
        method.trends = trends


def test_a_field_of_bearings_spares_components_pixels_and_its_variance(crossings):
    method, data, fold = crossings
    measured = reduced.contributions(method, data, fold.train)
    assert reduced.reduced(method, {"confidence": True}, measured) is method
    silent = reduced.reduced(method, {"confidence": False}, measured)
    assert away(method, silent, data, fold.test) < 1e-8 and answer(silent, data, fold.test).variance is None
    error = [
        away(method, reduced.reduced(method, settings, measured), data, fold.test)
        for settings in ({"keep": 0.5}, {"keep": 0.05})
    ]
    assert 0 < error[0] < error[1] < 0.3
    coarse = reduced.reduced(method, {"stride": 2}, measured)
    assert answer(coarse, data, fold.test).mean.shape == data.batch(fold.test).target.shape
    assert 0 < away(method, coarse, data, fold.test) < 0.05


def test_strides_that_do_not_divide_the_columns_are_left_out(field, caplog):
    """The command's own default strides ended it on grids of 7 x 13."""
    method = GaussianProcess()
    method.fit(field.data, field.split.folds[0], FitContext(Path()))
    columns = field.data.site.grid.width
    assert columns % 2 == 0 and columns % 3
    assert list(reduced.combinations(method, {"stride": [1, 2, 3]}, {})) == [{}, {"stride": 2}]
    assert f"stride=3: does not divide the {columns} columns" in caplog.text


def test_a_method_without_knobs_has_one_point(field):
    method = Mean()
    method.fit(field.data, field.split.folds[0], FitContext(Path()))
    assert list(reduced.combinations(method, {"keep": [1.0, 0.5]}, {"projection": ["equirect"]})) == [{}]
    assert reduced.reduced(method, {"keep": 0.5}, {}) is method


def test_channels_keep_the_strongest_and_spare_directions(tmp_path):
    found = train(compose(*brief(channels(tmp_path / "own.npz"))), tmp_path / "run")[1]
    method, data, fold = found.methods[0], found.data, found.split.folds[0]
    measured = reduced.contributions(method, data, fold.train)
    strongest = reduced.reduced(method, {"keep": 0.5}, measured)
    weakest = reduced.reduced(method, {"keep": 0.5}, {"contribution": -measured["contribution"]})
    assert strongest.size() == weakest.size() == 20
    assert away(method, strongest, data, fold.test) < away(method, weakest, data, fold.test)
    assert away(method, reduced.reduced(method, {"stride": 2}, measured), data, fold.test) < 0.2


def test_what_a_process_beside_adds_stays(field):
    data, fold = field.data, field.split.folds[0]
    method = copy.copy(field.methods[0])
    measured = reduced.contributions(method, data, fold.train)
    plain = answer(reduced.reduced(method, {"stride": 2}, measured), data, fold.test).mean
    beside = SimpleNamespace(predict=lambda tx, rx: SimpleNamespace(mean=torch.ones_like(plain)))
    method._average = (beside, 0.25)
    added = answer(reduced.reduced(method, {"stride": 2}, measured), data, fold.test).mean
    assert torch.allclose(0.75 * plain + 0.25, added)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_process_beside_spares_pixels_with_the_field(field, stride):
    data, fold = field.data, field.split.folds[0]
    method = copy.copy(field.methods[0])
    measured = reduced.contributions(method, data, fold.train)
    process = GaussianProcess()
    process.fit(data, fold, FitContext())
    method._average, method._average_mean = (process, 0.5), None
    alone = reduced.reduced(field.methods[0], {"stride": stride}, measured)
    spared = {"confidence": False, "stride": stride}
    wanted = 0.5 * answer(alone, data, fold.test).mean
    wanted += 0.5 * answer(process.reduced(spared, {}), data, fold.test).mean
    lean = reduced.reduced(method, {"stride": stride, "confidence": True}, measured)
    assert torch.allclose(answer(lean, data, fold.test).mean, wanted, atol=1e-4)
    whole = answer(process, data, fold.test).mean
    own = answer(field.methods[0], data, fold.test)
    both = answer(method, data, fold.test)
    assert torch.allclose(both.mean, 0.5 * own.mean + 0.5 * whole, atol=1e-4)  # its variance is not computed
    assert torch.equal(both.confidence, own.confidence)
