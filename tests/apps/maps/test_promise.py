"""What a promise covers, on towns that no calibration saw."""

import numpy as np
import pytest
from scipy.linalg import cholesky
from scipy.spatial.distance import cdist

from gsparc.apps.maps.intervals import cross_validate
from gsparc.apps.maps.promise import PromiseSettings, gather_promise
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold, make_split
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.prediction.left_out import Learned, held_out_levels
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

TOWNS, ROWS, SHARE = 30, 200, 0.9
NOISE_DB = (1.0, 4.0)  # of a measurement, by turns
MAST = np.array([20.0, 20.0, 8.0])


def drawn(seed: int):
    """A town of 80 x 60 m with 5 dB of shadowing over 15 m: what was measured, and the field (n,)
    [dB].
    """
    rng = np.random.default_rng([7, seed])
    place = np.column_stack([rng.uniform(0, [80, 60], (ROWS, 2)), np.full(ROWS, 1.5)])
    root = cholesky(np.exp(-cdist(place, place) / 15) + 1e-6 * np.eye(ROWS), lower=True)
    field = -30 - 30 * np.log10(cdist(place, MAST[None]))[:, 0] + 5 * root @ rng.normal(size=ROWS)
    level = field + NOISE_DB[seed % 2] * rng.normal(size=ROWS)
    return (
        from_arrays({"rx_position": place, "tx_position": MAST, "rssi_db": level}, {}),
        level,
        field,
    )


@pytest.mark.slow
def test_intervals_of_thirty_towns_hold_measurements_as_often_as_promised_and_fields_more_often():
    """83 to 92 % of noisy squares of three towns were in: that is how far three towns scatter."""
    parts = []
    for seed in range(TOWNS):
        data, level, field = drawn(seed)
        cut = SplitSettings("blocks", side_m=8.0, share=0.2, seed=seed)
        (fold,) = make_split(data.moving, cut).folds
        method, context = GaussianProcess(), FitContext(seed=seed)
        method.fit(data, fold, context)
        learned = Learned(method, GaussianProcess(), data, fold, context)
        promise = gather_promise(learned, PromiseSettings(seed=seed))
        tried = held_out_levels(method, data, fold, fold.test)
        far, half = tried.distance, promise.calibration(SHARE).half_of(tried)
        missed = (np.abs(one[fold.test] - tried.mean_db) for one in (level, field))
        found = np.column_stack(
            [far, *(miss <= half for miss in missed), np.full(len(far), seed % 2)]
        )
        parts.append(found[np.isfinite(half)])
    far, measured, true, noisy = np.concatenate(parts).T
    near, middle = np.quantile(far, [1 / 3, 2 / 3])
    masks = [
        far >= 0,
        far <= near,
        (far > near) & (far <= middle),
        far > middle,
        noisy == 0,
        noisy == 1,
    ]
    for mask in masks:
        error = np.sqrt(SHARE * (1 - SHARE) / mask.sum())
        assert abs(measured[mask].mean() - SHARE) < 2 * error
        assert true[mask].mean() > SHARE - 2 * error
    assert true[noisy == 1].mean() > 0.96


def test_a_map_of_sixty_rows_was_refused():
    """Four folds held out 48 of them, and four fifths of these are fewer
    than intervals are tested on.
    """
    data, _, _ = drawn(0)
    every = np.arange(60)
    fold, context = Fold(every, every[:0], every[:0]), FitContext()
    method = GaussianProcess()
    method.fit(data, fold, context)
    promise = gather_promise(
        Learned(method, GaussianProcess(), data, fold, context), PromiseSettings()
    )
    assert len(promise.evidence) >= 100 and cross_validate(promise.evidence, SHARE).share > 0.8


def test_a_fold_without_test_rows_ended_in_a_reshape():
    """`cannot reshape array of size 0`: a promise of a table of few rows."""
    data, _, _ = drawn(0)
    every, method = np.arange(ROWS), GaussianProcess()
    fold = Fold(every, every[:0], every[:0])
    method.fit(data, fold, FitContext())
    assert len(held_out_levels(method, data, fold, every[:0])) == 0
