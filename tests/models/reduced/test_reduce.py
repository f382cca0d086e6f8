"""Each kind of model spares what it says, stays near itself when little is spared,
and is left as it was.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, spectra

from gsparc.commands.train import TrainedRun, train
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.load import load
from gsparc.field.gaussians import FieldSettings
from gsparc.models import reduced
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.method import Method, Prediction
from gsparc.models.splat.array import ArrayField
from gsparc.training.context import FitContext


class Case(NamedTuple):
    """A fitted method, what it learned from, and what each of its parts contributes."""

    method: Any
    data: Measurements
    fold: Fold
    measured: dict[str, Any]

    @classmethod
    def of(cls, method: Method, data: Measurements, fold: Fold) -> Case:
        return cls(method, data, fold, method.reduction_inputs(data, fold.train))

    @classmethod
    def fit(cls, method: Method, data: Measurements, share: int = 4) -> Case:
        """Tested on every `share`-th row."""
        rows = np.arange(len(data))
        fold = Fold(rows[rows % share > 0], rows[:0], rows[::share])
        method.fit(data, fold, FitContext())
        return cls.of(method, data, fold)

    @classmethod
    def trained(cls, found: TrainedRun) -> Case:
        return cls.of(found.methods[0], found.data, found.split.folds[0])

    def less(self, measured: dict[str, Any] | None = None, **settings: Any) -> Any:
        return reduced.with_reduction(self.method, settings, measured or self.measured)

    def answer(self, method: Method | None = None, rows: np.ndarray | None = None) -> Prediction:
        batch = self.data.batch(self.fold.test if rows is None else rows)
        return (method or self.method).predict(batch)

    def away(self, other: Method) -> float:
        """Relative squared distance of its answers and another's."""
        a, b = self.answer().mean, self.answer(other).mean
        return float((a - b).abs().square().sum() / a.abs().square().sum())


@pytest.fixture(scope="module")
def field(tmp_path_factory) -> Case:
    """Forty Gaussians on forty spectra of 16 x 32 pixels, the receiver static."""
    folder = tmp_path_factory.mktemp("tradeoff")
    return Case.trained(train(compose(*brief(spectra(folder / "own.npz"))), folder / "run")[1])


@pytest.fixture(scope="module")
def process(field) -> Case:
    method = GaussianProcess()
    method.fit(field.data, field.fold, FitContext())
    return Case(method, field.data, field.fold, {})


def test_what_a_splatted_field_spares_stays_near_it(field):
    before, lean = field.answer().mean.clone(), field.less(stride=2)
    assert field.answer(lean).mean.shape == field.data.batch(field.fold.test).target.shape
    assert field.away(lean) < 0.1 and torch.equal(field.answer().mean, before)


def test_confidence_that_is_spared_is_not_computed(field):
    lean = field.less(confidence=False)
    assert field.answer(lean).confidence is None and field.answer().confidence is not None
    assert field.away(lean) == 0


@pytest.fixture(scope="module")
def through_array(tmp_path_factory) -> Case:
    data = load(
        {"name": "rfid_sim", "count": 48, "root": str(tmp_path_factory.mktemp("sim")), "seed": 0}
    )
    return Case.fit(ArrayField(FieldSettings(count=64)), data)


def test_fewer_places_say_what_all_of_them_said(through_array):
    case = through_array
    assert case.method.reduction_settings() == ("keep", "stride", "confidence")
    ways = [case.less(keep=share) for share in (1.0, 0.75, 0.1)]
    assert [way.fitted_model().emission.encoding.width for way in ways] == [36, 27, 4]
    assert case.method.fitted_model().emission.encoding.width == 36
    error = [case.away(way) for way in ways]
    assert error[0] < 1e-5 < error[1] < error[2]
    unsure = [float(case.answer(way, case.fold.train).confidence.mean()) for way in ways]
    assert unsure[0] > unsure[1] > unsure[2]


def test_a_gaussian_process_spares_components_pixels_and_its_variance(process):
    whole = process.less(confidence=False)
    assert process.away(whole) < 1e-8 and process.answer(whole).variance is None
    assert process.less(confidence=True) is process.method
    few = process.less(keep=0.2, stride=2)
    assert few.count_components() < len(process.method.axes) and 0 < process.away(few) < 0.3


def test_strides_that_do_not_divide_the_columns_are_left_out(process, caplog):
    """The command's own default strides ended it on grids of 7 x 13."""
    columns = process.data.site.grid.width
    assert columns % 2 == 0 and columns % 3
    assert list(reduced.list_settings(process.method, {"stride": [1, 2, 3]})) == [{}, {"stride": 2}]
    assert f"stride=3: does not divide the {columns} columns" in caplog.text


def test_a_method_without_knobs_has_one_point(field):
    method = Mean()
    method.fit(field.data, field.fold, FitContext(Path()))
    assert list(reduced.list_settings(method, {"keep": [1.0, 0.5]})) == [{}]
    assert reduced.with_reduction(method, {"keep": 0.5}, {}) is method


def test_rendered_channels_spare_directions(tmp_path):
    case = Case.trained(train(compose(*brief(channels(tmp_path / "own.npz"))), tmp_path / "run")[1])
    assert case.away(case.less(stride=2)) < 0.2
