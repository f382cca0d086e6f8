"""What misses rows left out by more than what is simpler answers nothing; what is right is never refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from boxes import room_of_spectra
from closed import fitted_to
from scenes import fold_of

from gsparc.data.errors import Severe
from gsparc.data.own import from_arrays
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import checkpoint, fitting, loading, sanity
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.models.closed_form import LeftOutRows
from gsparc.models.mixture.methods import Powers
from gsparc.models.per_station import PerStation
from gsparc.models.powers.together import learning
from gsparc.prediction.left_out import predict_rows
from gsparc.processes.kernel import Kernel
from gsparc.training.context import FitContext


def lying_still() -> Measurements:
    """Levels of three stations, 4 dB of noise, about a street and, half of them, where a phone lay still."""
    rng = np.random.default_rng(1)
    walk = np.c_[rng.uniform(0, 200, (40, 2)), np.full(40, 1.5)]
    spot = walk[0] + np.c_[rng.normal(0, 0.02, (40, 2)), rng.normal(0, 15, 40)]
    place, posts = np.concatenate([walk, spot]), np.array([[0.0, -3e3, 20], [3e3, 0, 20], [90, 4e3, 20]])
    far = np.linalg.norm(place[:, None] - posts, axis=-1)
    levels = -30 * np.log10(far) + rng.normal(0, 4, far.shape)
    return from_arrays({"rx_position": place, "station_position": posts, "rssi_db": levels})


def walk_into_a_corner(monkeypatch) -> None:
    """Have all stations alike choose long lengths and no noise, as a slope that was NaN once did."""
    right = learning._fit_common_kernel

    def wrong(*given):
        kernel, priors = right(*given)
        long = Kernel.from_lengths((300.0, 900.0), (0.5, 0.5), 1e-6, kernel.amplitude)
        return long, {number: replace(prior, kernel=long) for number, prior in priors.items()}

    monkeypatch.setattr(learning, "_fit_common_kernel", wrong)


def fitted(folder, data, fold):
    return fitting.fit_or_resume(PerStation(Powers()), data, fold, FitContext(folder, stations="together"))


def test_a_fit_in_a_corner_predicted_47_dbm_where_minus_86_was_heard(monkeypatch, tmp_path):
    """Nothing asked whether it predicts what it learned from better than the mean of each station does."""
    data = lying_still()
    fold = fold_of(data)
    sane, report = fitted(tmp_path, data, fold)
    assert not any(isinstance(note, Severe) for note in report.notes)
    walk_into_a_corner(monkeypatch)
    method, report = fitted(tmp_path, data, fold)
    (text,) = (note for note in report.notes if isinstance(note, Severe))
    assert "answers nothing: at " in text and text.endswith("; the plain mean answers")
    mean = PerStation(Mean())
    mean.fit(data, fold, FitContext(tmp_path, stations="each"))
    said, plain = (predict_rows(one, data, fold.test).mean for one in (method, mean))
    assert torch.equal(said, plain) and not torch.equal(said, predict_rows(sane, data, fold.test).mean)

    checkpoint.save(
        tmp_path / "model.ckpt", method, extra=fitting.run_extra(report, data, fold, FitContext())
    )
    stored = checkpoint.read(tmp_path / "model.ckpt")
    assert text in stored.extra["notes"]
    again = loading.rebuild_method(Powers(), stored)
    assert torch.equal(predict_rows(again, data, fold.test).mean, said)


def test_what_is_right_is_not_refused(campaign, folds, tmp_path):
    fold = folds(60).folds[0]
    method, report = fitting.fit_or_resume(Powers(), campaign("rssi", 60), fold, FitContext(tmp_path))
    assert not any(isinstance(note, Severe) for note in report.notes) and not isinstance(method, Mean)


def test_a_member_that_answers_what_is_no_number_answers_nothing():
    data, rows = room_of_spectra(), np.arange(40)
    good, _ = fitted_to(GaussianProcess(), data, rows)
    poisoned, _ = fitted_to(GaussianProcess(), data, rows)
    poisoned.mean = poisoned.mean * torch.nan
    fold = Fold(rows, np.arange(40, 60), rows[:0])
    kept, texts = sanity._refuse_members([(0.5, good), (0.5, poisoned)], data, fold)
    assert kept == [good] and len(texts) == 1 and "NaN" in texts[0]


def test_a_mixture_does_without_a_member_that_is_worse_than_the_simpler_one():
    data, rows = room_of_spectra(), np.arange(40)
    members = [fitted_to(GaussianProcess(), data, rows)[0] for _ in range(2)]
    members[1].mean, members[1].count_gaussians = members[1].mean + 0.3, 5
    both = Powers()
    both.members, both.weights, both.started = members, (0.25, 0.75), "process+bearings"
    kept, texts = sanity._refuse_members(
        [(0.25, members[0]), (0.75, members[1])], data, Fold(rows, np.arange(40, 60), rows[:0])
    )
    both.keep_members(kept)
    assert both.members == members[:1] and both.weights == (1.0,) and both.started == "process"
    assert "times that of gp" in texts[0]


def test_rows_are_drawn_over_stations_and_small_ones_are_whole():
    station = np.repeat(np.arange(7), [300, 300, 20, 300, 3, 300, 300])
    rows = sanity._draw_over_stations(np.arange(len(station)), station)
    assert len(rows) == sanity.JUDGED and set(np.bincount(station[rows])) == {195, 196, 20, 3}


def test_the_mean_is_that_of_the_other_rows_of_a_station():
    data = lying_still()
    rows = np.arange(0, len(data), 7)
    every, level = np.arange(len(data)), data.site.target.to_real(data.target)[:, 0].astype(float)
    alone = LeftOutRows(rows, torch.zeros(0), torch.zeros(0))
    errors = sanity._errors_of_mean(data, Fold.of_all(every), rows, alone)
    for row, error in zip(rows, errors, strict=True):
        others = (data.station == data.station[row]) & (every != row)
        assert error == pytest.approx((level[row] - level[others].mean()) ** 2, rel=1e-3)
