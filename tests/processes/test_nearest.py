"""Powers of very many rows, each place told by the nearest: where that is exact,
and what it says.
"""

import numpy as np
import pytest
import torch

from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.reduced import with_reduction
from gsparc.processes import neighbourhood, powers
from gsparc.processes.kernel import Kernel, SmoothRough
from gsparc.processes.nearest import Nearest, PlaceValues
from gsparc.processes.nearest import condition_on_nearest as given_places
from gsparc.processes.neighbourhood import NEIGHBOURS
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerProcess, PowerRows, condition_on_powers
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend
from tests.models.baselines.test_likeliest import error_db, fit, town

KERNEL = Kernel.from_lengths((60.0, 300.0), (0.3, 0.7), 0.05, 30.0)


def rows_of(data, count: int) -> PowerRows:
    return PowerRows(
        data.moving[:count],
        10 * np.log10(data.target[:count, 0]).astype(float),
        np.zeros(count, bool),
    )


def given(rows: PowerRows, most: int = NEIGHBOURS) -> PowerProcess:
    """The same process by nearest rows."""
    values = PlaceValues.from_rows(rows.places, torch.from_numpy(rows.decibels)[:, None])
    heard = float(np.average((rows.decibels - rows.decibels.mean()) ** 2)) / KERNEL.amplitude
    return PowerProcess(
        given_places(Prior(KERNEL, Trend(-100.0)), values, 0, neighbours=most), heard
    )


@pytest.fixture
def many(monkeypatch):
    """100 rows are already many."""
    monkeypatch.setattr(powers, "MOST_ROWS", 100)
    monkeypatch.setattr(neighbourhood, "FEWEST", 30)


def test_given_all_rows_as_neighbours_it_is_the_exact_process():
    data = town(140)
    rows = rows_of(data, 120)
    whole, _ = condition_on_powers(rows, Prior(KERNEL, Trend(-100.0)), 0)
    near = given(rows, 1000)
    queries = torch.from_numpy(np.concatenate([data.moving[120:], data.moving[120:] + 3000.0]))
    for one, other in zip(near.answer(queries), whole.answer(queries), strict=True):
        assert np.allclose(one, other, rtol=1e-5)
    assert np.allclose(near.mean_at(queries), whole.mean_at(queries))


def test_the_only_place_was_its_own_neighbour():
    one = neighbourhood.Neighbourhood.from_places(np.zeros((1, 3)), 0)
    assert one.nearest_rows(np.zeros((2, 3)), np.zeros(2, int)).shape == (2, 0)
    assert one.nearest_rows(np.ones((1, 3))).tolist() == [[0]]
    assert np.allclose(neighbourhood.nearest_distance(one.tree, torch.ones(1, 3).double()), 3**0.5)


def test_rows_of_one_place_are_its_mean_and_lose_nothing():
    data, rng = town(60), np.random.default_rng(0)
    often = np.repeat(np.arange(40), 3)
    rows = rows_of(data, 60).subset(often)
    rows = PowerRows(rows.places, rows.decibels + rng.normal(size=120), rows.silent)
    whole, _ = condition_on_powers(rows, Prior(KERNEL, Trend(-100.0)), 0)
    near = given(rows, 1000)
    assert len(near.places) == 40
    for one, other in zip(
        near.answer(torch.from_numpy(data.moving)),
        whole.answer(torch.from_numpy(data.moving)),
        strict=True,
    ):
        assert np.allclose(one, other, rtol=1e-4)


def test_thirty_neighbours_tell_nearly_all_and_the_label_says_so(many):
    data = town(450)
    near, whole = GaussianProcess(), GaussianProcess()
    batch, notes = fit(near, data, 300)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(powers, "MOST_ROWS", 10_000)
        fit(whole, data, 300)
    assert near.label == "gp (Vecchia 30)" and whole.label == "gp"
    assert "gp: each place is predicted from the 30 nearest of 300 (Vecchia)" in notes
    assert error_db(near, batch) < 1.03 * error_db(whole, batch)


def test_silent_rows_stay_known_and_are_counted(many):
    data = town(300)
    level = float(np.quantile(data.target, 0.3))
    silent = data.target[:, 0] < level
    rows = PowerRows(
        data.moving, 10 * np.log10(np.where(silent, level, data.target[:, 0])).astype(float), silent
    )
    process, notes = condition_on_powers(rows, Prior(KERNEL, Trend(-100.0)), 0)
    assert any("of 90 censored rows 30, drawn evenly, are looked at" in note for note in notes), (
        notes
    )
    loud = rows.subset(np.flatnonzero(~silent))
    deaf = given(loud)
    truth = 10 * np.log10(data.target[silent, 0])
    heard, unheard = (
        np.abs(p.mean_at(torch.from_numpy(data.moving[silent])).numpy() - truth).mean()
        for p in (process, deaf)
    )
    assert heard < unheard


def test_left_out_is_a_prediction_without_each_place():
    data = town(50)
    rows = rows_of(data, 50)
    near = given(rows, 1000)
    whole, _ = condition_on_powers(rows, Prior(KERNEL, Trend(-100.0)), 0)
    exactly, spread = (part.numpy() for part in whole.posterior.left_out())
    mean, variance = (part.numpy() for part in near.posterior.left_out())
    # What the terms weigh is known from all rows, the one that is left out among them.
    assert np.abs(mean[:, 0] - exactly[:, 0]).max() < 0.3
    assert np.allclose(variance, spread, rtol=0.05)


def test_covariances_are_those_of_rows_that_cover_the_site(many):
    data = town(400)
    rows = rows_of(data, 300)
    process, _ = condition_on_powers(rows, Prior(KERNEL, Trend(-100.0)), 0)
    few = process.with_exact_posterior()
    assert (
        len(few.places) == 100
        and few.with_exact_posterior() == few
        and isinstance(few.posterior, Exact)
    )
    queries = torch.from_numpy(data.moving[300:])
    wide, narrow = few.answer(queries)[1], process.answer(queries)[1]
    assert isinstance(process.posterior, Nearest) and (wide >= narrow * 0.99).float().mean() > 0.95


@pytest.mark.parametrize("kind", ["csi", "spectrum"])
def test_whole_targets_of_many_rows_are_told_by_the_nearest(campaign, monkeypatch, tmp_path, kind):
    data, near, whole = campaign(kind, 90), GaussianProcess(), GaussianProcess()
    batch, _ = fit(whole, data, 80)
    monkeypatch.setattr("gsparc.models.baselines.gp.MOST_ROWS", 40)
    batch, notes = fit(near, data, 80)
    assert near.label == "gp (Vecchia 30)" and whole.label == "gp"
    assert "gp: each query is predicted from the 30 nearest of 80 rows (Vecchia)" in notes
    said, exactly = near.predict(batch), whole.predict(batch)
    target = batch.target
    errors = [float((found.mean - target).abs().square().mean()) for found in (said, exactly)]
    # Very smooth
    assert errors[0] < 2 * errors[1] < 0.1 * float(target.abs().square().mean()), errors
    assert 0.3 < float(said.variance.mean() / exactly.variance.mean()) < 3
    torch.save(near.state(), tmp_path / "state.pt")
    again = GaussianProcess()
    again.restore(data.site, torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(again.predict(batch).mean, said.mean)
    assert torch.allclose(near.mean_at(batch), said.mean)
    lean = with_reduction(near, {"confidence": False}, {}).predict(batch)
    assert lean.variance is None and torch.allclose(lean.mean, said.mean)


def test_a_kernel_of_other_correlations_was_answered_as_a_sum_of_matern():
    rng = np.random.default_rng(0)
    places, values = rng.uniform(0, 1, (40, 3)), torch.from_numpy(rng.normal(size=(40, 1)))
    prior = Prior(Kernel.from_length(0.5, 0.1, term=SmoothRough))
    queries = torch.from_numpy(rng.uniform(0, 1, (5, 3)))
    near = given_places(prior, PlaceValues.from_rows(places, values), 0, neighbours=40).answer(
        queries
    )
    exact = Exact.from_values(prior, torch.from_numpy(places), values).answer(queries)
    assert torch.allclose(near.mean, exact.mean, atol=1e-6)
    assert torch.allclose(near.variance, exact.variance, atol=1e-6)
