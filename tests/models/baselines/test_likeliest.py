"""The process of powers: its likelihood's slopes, its choices, and what it does with many rows."""

import numpy as np
import pytest
import torch
from releases import real

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.kriging import Kriging
from gsparc.models.baselines.likeliest import fit_power_process
from gsparc.models.reduced import with_reduction
from gsparc.models.target_rows import power_rows
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext
from tests.models.powers.test_mixture import station


def town(
    count: int, exponent: float = 3.0, shadowing_db: float = 4.0, seed: int = 0
) -> Measurements:
    """A square kilometre about a station; shadowing over 60 m, 1 dB of noise."""
    rng = np.random.default_rng(seed)
    places = np.c_[rng.uniform(0, 1000, (count, 2)), np.full(count, 1.5)]
    station, waves = np.array([480.0, 520.0, 20.0]), rng.normal(size=(3, 200)) / 60
    shadow = np.cos(places @ waves + rng.uniform(0, 2 * np.pi, 200)) @ rng.normal(size=200) / 10
    decibels = -30 - 10 * exponent * np.log10(np.linalg.norm(places - station, axis=1))
    decibels += shadowing_db * shadow + rng.standard_normal(count)
    return from_arrays(
        {"rx_position": places, "tx_position": station, "rssi_db": decibels}, {"name": "town"}
    )


def fit(method, data: Measurements, known: int):
    rows = np.arange(len(data))
    notes = method.fit(data, Fold(rows[:known], rows[:0], rows[known:]), FitContext()).notes
    return data.batch(rows[known:]), notes


def error_db(method, batch) -> float:
    found = method.predict(batch).mean
    return float((10 * torch.log10(found / batch.target)).square().mean().sqrt())


def test_few_rows_do_not_choose_a_process_that_varies_far_more_than_they_do():
    """97 rows of a measured station chose 2 km and next to no noise:
    up to 63 dBm where nobody measured.
    """
    with np.load(real("real/powder-rss-462mhz.npz")) as stored:
        number = stored["station"].tolist().index("law73-nuc2-b210")
    data = station(number, 97, 9)
    rows = power_rows(data, np.arange(97))
    process, _ = fit_power_process(rows, data.site)
    assert process.kernel.amplitude < 3 * rows.decibels.var()  # 6.6 times without the bound


def test_the_mean_is_chosen_by_likelihood_and_by_name():
    falling, flat = town(60, exponent=4.0, shadowing_db=0.0), town(60, exponent=0.0)
    for data, about, said in (
        (falling, "auto", "mean: a distance law of exponent"),
        (flat, "auto", "mean: a constant"),
        (falling, "constant", "mean: a constant"),
        (flat, "distance", "mean: a distance law"),
    ):
        assert said in fit(GaussianProcess(mean=about), data, 50)[1][0]
    with pytest.raises(ValueError, match="mean='flat': one of auto, constant, distance is needed"):
        GaussianProcess(mean="flat")


def test_intervals_cover_what_they_promise():
    data = town(420)
    method = GaussianProcess()
    batch, _ = fit(method, data, 300)
    found = method.predict(batch)
    missed = 10 * torch.log10(found.mean / batch.target)[:, 0]
    deviation = found.variance.sqrt() / (np.log(10) / 10 * found.mean[:, 0])
    assert 0.83 < float((missed.abs() < 1.645 * deviation).float().mean()) < 0.97
    assert found.confidence.min() >= 0 and found.confidence.max() <= 1


def test_a_mean_alone_has_no_variance():
    data, method = town(120), GaussianProcess()
    batch, _ = fit(method, data, 100)
    lean = with_reduction(method, {"confidence": False}, {}).predict(batch)
    assert lean.variance is None and method.reduction_settings() == ("confidence",)
    assert torch.allclose(lean.mean, method.predict(batch).mean, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("make", [GaussianProcess, Kriging])
def test_five_thousand_rows(make):
    data, method = town(5_100), make()
    batch, _ = fit(method, data, 5_000)
    assert error_db(method, batch) < 4.0


def test_a_constant_was_taken_where_a_distance_law_was_there_to_be_had():
    """Rows at nearly one distance tell the two means hardly apart;
    2 km farther the constant stayed.
    """
    rng = np.random.default_rng(0)
    places = np.c_[rng.uniform(-100, 100, 80), rng.uniform(380, 420, 80), np.full(80, 1.5)]
    station, waves = np.array([0.0, 0.0, 20.0]), rng.normal(size=(2, 100)) / 40
    shadow = np.cos(places[:, :2] @ waves + rng.uniform(0, 2 * np.pi, 100)).sum(axis=1) / 7
    decibels = (
        -30
        - 30 * np.log10(np.linalg.norm(places - station, axis=1))
        + 3 * shadow
        + rng.normal(size=80)
    )
    arrays = {"rx_position": places, "tx_position": station, "rssi_db": decibels}
    data = from_arrays(arrays, {"name": "street"})
    process, notes = fit_power_process(power_rows(data, np.arange(80)), data.site)
    assert process.trend.law is not None and "a distance law" in notes[0]
    near, far = np.array([[0.0, 400.0, 1.5], [0.0, 2400.0, 1.5]]) - data.site.origin
    mean, *_ = process.answer(torch.from_numpy(np.stack([near, far])))
    assert mean[0] - mean[1] > 10


def test_rows_within_centimetres_said_infinite_powers_a_kilometre_away():
    """The slope of a law was free by the spread of the rows' distances,
    here a hundredth of a decade.
    """
    rng = np.random.default_rng(3)
    places = np.repeat([[0.0, 0.70, 0.6], [0.1, 0.72, -0.6]], 4, axis=0)
    decibels = np.repeat([-68.6, -66.4], 4) + 0.3 * rng.standard_normal(8)
    still = np.array([-1.0, -0.7, 0.0])
    data = from_arrays(
        {"rx_position": places, "tx_position": still, "rssi_db": decibels}, {"name": "shelf"}
    )
    for mean in ("auto", "distance"):
        process, _ = fit_power_process(power_rows(data, np.arange(8)), data.site, mean=mean)
        far = torch.eye(3, dtype=torch.float64) * 1000.0
        found, *_ = process.answer(far)
        assert (found + 67.5).abs().max() < 150, (mean, found)
