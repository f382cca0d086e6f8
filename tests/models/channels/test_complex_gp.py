from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms import nmse, shoebox
from scenes import error

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.models.channels import complex_gp
from gsparc.models.channels.complex_gp import ComplexGP
from gsparc.models.run_factors import best_run_factors, factor_matrix
from gsparc.physics.waves import LIGHT
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def _dense():
    """Receivers a third of a wavelength apart: close enough to interpolate without sources."""
    _, data, fold = shoebox(260, size=(0.7, 0.6, 0.6), max_order=1)
    return data, fold


def _fit(data, fold):
    method = ComplexGP()
    return method, method.fit(data, fold, FitContext()).notes


@pytest.fixture(scope="module")
def dense():
    """Those receivers, and what is learned of them."""
    data, fold = _dense()
    return data, fold, *_fit(data, fold)


def test_dense_receivers_tell_and_far_away_nothing_is_said(dense):
    data, fold, method, notes = dense
    batch = data.batch(fold.test)
    prediction = method.predict(batch)
    assert nmse(prediction.mean.numpy(), batch.target.numpy()) < 0.3
    missed = (prediction.mean - batch.target).abs().square().mean()
    assert 0.2 < prediction.variance.mean() / missed < 5
    assert len(notes) == 1 and notes[0].startswith("complex_gp: envelope")
    one_run, _ = _fit(replace(data, run=np.full(len(data), 3)), fold)
    assert torch.equal(one_run.predict(batch).mean, prediction.mean)
    far = method.predict(Query(batch.tx, replace(batch.rx, position=batch.rx.position + 1000)))
    assert far.mean.abs().max() < 1e-3 and far.confidence.max() < 1e-3


def test_places_visited_again_hid_all_others_from_the_nearest_rows(monkeypatch):
    """From 6,001 rows on the nearest hundred were visits of one place:
    NMSE .31 for .07 with fewer.
    """
    monkeypatch.setattr(complex_gp, "NEAREST", 24)
    rng = np.random.default_rng(0)
    place, asked = (np.column_stack([rng.uniform(0, 0.4, (n, 2)), np.ones(n)]) for n in (50, 40))
    waves = rng.normal(size=(12, 3))
    waves *= 50 / np.linalg.norm(waves, axis=1, keepdims=True)
    power = rng.normal(size=12)
    visits = rng.permutation(np.repeat(np.arange(50), 8))
    noise = rng.normal(size=(400, 2)) @ [0.5, 0.5j]
    arrays = {"tx_position": np.full(3, 9.0), "frequency_hz": np.array(50 * LIGHT / (2 * np.pi))}
    errors = []
    for most in (6_000, 300):
        monkeypatch.setattr(complex_gp, "MOST_ROWS", most)
        csi = np.exp(1j * place[visits] @ waves.T) @ power + noise
        data = from_arrays({**arrays, "rx_position": place[visits], "csi": csi})
        rows = np.arange(400)
        method, notes = _fit(data, Fold(rows, rows[:0], rows[:5]))
        found = Predictor(method, data.site).csi(rx=asked)[:, 0, 0]
        errors.append(nmse(found, np.exp(1j * asked @ waves.T) @ power))
    assert any("nearest of 50 places, of 400 rows" in note for note in notes)
    assert errors[1] < 1.5 * errors[0] < 0.2, errors
    assert len(method.posterior.places) == 50


def _in_runs(factors, seed=0):
    """Dense receivers, each in one of several runs that share a factor; the largest run's is 1."""
    data, fold = _dense()
    odds = np.array([0.5, *[0.5 / (len(factors) - 1)] * (len(factors) - 1)])
    run = np.random.default_rng(seed).choice(len(factors), len(data), p=odds)
    target = data.target * np.asarray(factors, np.complex64)[run][:, None, None]
    return data, replace(data, target=target, run=run + 5), fold


FACTORS = [1.0, 0.5 * np.exp(2j), 1.7 * np.exp(-1j)]


@pytest.fixture(scope="module")
def runs():
    """Receivers in three runs, and what is learned of them."""
    clean, spread, fold = _in_runs(FACTORS)
    return clean, spread, fold, *_fit(spread, fold)


def test_runs_are_brought_together(dense, runs):
    clean, spread, fold, method, notes = runs
    truth = clean.batch(fold.test).target.numpy()
    ignored, _ = _fit(replace(spread, run=None), fold)
    one, known, other = (
        nmse(each.predict(Query(*ends)).mean.numpy(), truth)
        for ends in [(clean.batch(fold.test).tx, clean.batch(fold.test).rx)]
        for each in (dense[2], method, ignored)
    )
    assert known < 1.5 * one < 0.5 * other, (one, known, other)
    assert notes[1].startswith(
        "complex_gp: factors of runs, relative to run 5: 5: 1 at 0 degrees, 6: "
    )
    ratio = method.runs.look_up(torch.tensor([5, 6, 7])).numpy() / FACTORS
    assert np.abs(np.angle(ratio)).max() < 0.1 and np.abs(np.log(np.abs(ratio))).max() < 0.3


def test_rows_of_other_runs_were_scored_in_the_phase_of_the_largest(runs):
    """A right prediction of a row in another run's phase was an error of up
    to four times its power.
    """
    _, spread, fold, method, _ = runs
    batch = spread.batch(fold.test)
    here = method.predict(batch).mean
    assert nmse(here.numpy(), batch.target.numpy()) < 0.2 * error(method, spread, fold.test)
    strange = replace(batch, run=torch.full((len(batch),), 99))
    assert torch.equal(method.predict(strange).mean, method.predict(Query(batch.tx, batch.rx)).mean)


def test_factors_of_many_runs():
    """Forty runs of ten rows each of one smooth process."""
    rng = np.random.default_rng(0)
    place, run = rng.uniform(0, 4, (400, 1)), np.arange(400) % 40
    gram = np.exp(-((place - place.T) ** 2)) + 1e-3 * np.eye(400)
    root = np.linalg.cholesky(gram)
    channel = root @ (rng.standard_normal((400, 3)) + 1j * rng.standard_normal((400, 3)))
    factors = np.exp(rng.normal(size=40) * 0.3 + 2j * np.pi * rng.random(40))
    quadratic = factor_matrix(np.linalg.inv(gram), factors[run][:, None] * channel, run)
    found = best_run_factors(quadratic, 3 * np.bincount(run))
    wanted = factors[0] / factors
    assert np.allclose(found / wanted, (found / wanted).mean(), rtol=0.02)


def test_settings_of_many_rows_are_chosen_on_some(monkeypatch):
    monkeypatch.setattr(complex_gp, "CHOSEN_ON", 100)
    data, fold = _dense()
    method, notes = _fit(data, fold)
    assert f"on 100 of {len(fold.train) + len(fold.val)} rows, drawn evenly" in notes[1]
    assert error(method, data, fold.test) < 0.3
