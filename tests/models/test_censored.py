"""Rows where nothing was heard: the likelihood of "below the level",
and a town half of which is silent.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models.baselines.likeliest import fit_power_process
from gsparc.models.registry import build
from gsparc.models.target_rows import heard_rows
from gsparc.processes.powers import PowerRows
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

STATION = np.array([500.0, 500.0, 20.0])
SHADOWING_DB, LENGTH_M, NOISE_DB = 7.0, 80.0, 1.5


def town(count: int = 350, seed: int = 0) -> tuple[Measurements, np.ndarray, np.ndarray]:
    """A kilometre of streets, half of it below the sensitivity; true powers [dB],
    and which were heard.
    """
    rng = np.random.default_rng(seed)
    places = np.c_[rng.uniform(0, 1000, (count, 2)), np.full(count, 1.5)]
    gap = np.sqrt(3) * cdist(places, places) / LENGTH_M
    root = np.linalg.cholesky((1 + gap) * np.exp(-gap) + 1e-9 * np.eye(count))
    law = -20 - 32 * np.log10(np.linalg.norm(places - STATION, axis=1))
    true = law + SHADOWING_DB * root @ rng.standard_normal(count)
    level = float(np.median(true))
    measured = true + NOISE_DB * rng.standard_normal(count)
    silent = measured < level
    shown = np.where(silent, level, measured)
    arrays = {
        "rx_position": places,
        "tx_position": STATION,
        "rssi_db": shown,
        "carrier_hz": np.array(9e8),
    }
    data = from_arrays(arrays, {"name": "town"})
    return replace(data, censored=silent, mask=~silent[:, None]), true, silent


def fold_of(data: Measurements, share: float = 0.6) -> Fold:
    rows = np.random.default_rng(1).permutation(len(data))
    cut = round(share * len(rows))
    return Fold(np.sort(rows[:cut]), rows[:0], np.sort(rows[cut:]))


def predicted(model: str, data: Measurements, rows: np.ndarray, asked: np.ndarray):
    """Mean and deviation [dB] at rows `asked` of a fit to `rows`, and its notes."""
    method = build({"_target_": model})
    report = method.fit(data, Fold(rows, rows[:0], asked), FitContext())
    batch = data.batch(asked)
    found = method.predict(batch)
    power = found.mean[:, 0].double()
    deviation = found.variance.double().sqrt() / (np.log(10) / 10 * power)
    return (
        (10 * torch.log10(power * data.site.target_scale)).numpy(),
        deviation.numpy(),
        report.notes,
    )


MODELS = [
    "gsparc.models.baselines.distance_law.DistanceLaw",
    "gsparc.models.baselines.gp.GaussianProcess",
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "margin"), list(zip(MODELS, (0.93, 0.85), strict=True)))
def test_silent_rows_tell_of_a_half_silent_town(model, margin):
    """Over all places, learned from and not:
    the truth is nearer when silence counts as "below the level".
    """
    ratios, inside = [], []
    for seed in range(3):
        data, true, _ = town(seed=seed)
        fold, everywhere = fold_of(data), np.arange(len(data))
        told, deviation, _ = predicted(model, data, fold.train, everywhere)
        untold = predicted(model, data, heard_rows(data, fold.train), everywhere)[0]
        error = [float(np.sqrt(((one - true) ** 2).mean())) for one in (told, untold)]
        ratios.append(error[0] / error[1])
        new = fold.test
        inside.append(np.abs(told - true)[new] < 1.645 * deviation[new])
    assert np.mean(ratios) < margin and max(ratios) < 1, ratios
    assert 0.84 < np.mean(inside) < 0.96, np.mean(inside)  # of 90 %


@pytest.mark.parametrize("model", MODELS)
def test_saturated_rows_were_learned_as_measured(model):
    """The strongest 8.6 %, as one receiver in flight had them:
    too weak by 5 dB about the station.
    """
    data, true, _ = town()
    level = np.where(data.censored, true, 10 * np.log10(data.target[:, 0] * data.site.target_scale))
    arrays = {"rx_position": data.rx_position + data.site.origin, "tx_position": STATION}
    top = np.quantile(level, 0.914)
    error = {}
    for how in ("none", "auto"):
        clipped = from_arrays(arrays | {"rssi_db": np.minimum(level, top)}, {"saturation_db": how})
        found = predicted(model, clipped, fold_of(clipped).train, np.arange(len(clipped)))
        error[how] = (found[0] - true)[level > top]
    assert any("in saturation are above their level" in note for note in found[2]) == (
        "gp" in model
    )
    assert np.abs(error["auto"]).mean() < 0.7 * np.abs(error["none"]).mean()


def test_the_process_says_what_it_did_with_silent_rows():
    data, _, silent = town(200)
    rows = np.arange(len(data))
    notes = predicted(MODELS[1], data, rows, rows)[2]
    assert f"gp: {silent.sum()} rows where nothing was heard are below their level" in notes


@pytest.mark.parametrize(
    "model", ["gsparc.models.baselines.idw.InverseDistance", "gsparc.models.baselines.mean.Mean"]
)
def test_what_cannot_use_them_leaves_them_out_and_says_so(model):
    data, _, silent = town(60)
    rows = np.arange(len(data))
    asked = rows[:10]
    found = build({"_target_": model})
    notes = found.fit(data, Fold(rows, rows[:0], asked), FitContext()).notes
    assert notes == (
        f"{found.name}: {silent.sum()} rows where nothing was heard are not learned from",
    )
    assert found.count_components() == (~silent).sum()
    again = build({"_target_": model})
    assert not again.fit(data, Fold(heard_rows(data, rows), rows[:0], asked), FitContext()).notes
    batch = data.batch(asked)
    assert torch.equal(found.predict(batch).mean, again.predict(batch).mean)


def test_nothing_heard_at_all_is_finite():
    data, _, _ = town(40)
    deaf = replace(data, censored=np.ones(40, bool), mask=np.zeros((40, 1), bool))
    for model in MODELS:
        found, deviation, _ = predicted(model, deaf, np.arange(40), np.arange(40))
        assert np.isfinite(found).all() and np.isfinite(deviation).all()


def test_silent_rows_alone_do_not_make_powers_spread_beyond_any_site():
    """One row of forty heard, 20 dB above the level: the process fell to 167 dB below it."""
    data, _, _ = town(40)
    level = float(10 * np.log10(data.target.max()))
    quiet = np.arange(40) > 0
    rows = PowerRows(data.moving, np.where(quiet, level - 20, level), quiet)
    process, _ = fit_power_process(rows, data.site)
    assert process.kernel.amplitude < 1001
    assert process.answer(torch.from_numpy(data.moving))[0].min() > level - 100


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_noise_was_learned_as_signal(model):
    """Half of the powers lie below a receiver's noise, which it reports:
    levels below that were refused.
    """
    ratios, inside = [], []
    for seed in range(2):
        data, true, _ = town(seed=seed)
        level, rng = float(np.median(true)), np.random.default_rng(seed)
        noise = level + 0.7 * rng.standard_normal(len(true))
        shown = 10 * np.log10(10 ** (true / 10) + 10 ** (noise / 10))
        arrays = {"rx_position": data.rx_position + data.site.origin, "tx_position": STATION}
        arrays |= {"rssi_db": shown, "carrier_hz": np.array(9e8)}
        errors = []
        for more in ({}, {"sensitivity_db": level + 2.0}):
            read = from_arrays(arrays | more)
            found, deviation, _ = predicted(model, read, fold_of(read).train, np.arange(len(read)))
            errors.append(np.abs(found - true))
            inside.append((errors[-1] < 1.645 * deviation).mean())
        ratios.append(np.sqrt((errors[1] ** 2).mean() / (errors[0] ** 2).mean()))
    assert max(ratios) < 0.95 and np.mean(ratios) < 0.92, ratios
