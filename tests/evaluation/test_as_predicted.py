"""What is printed is what `gsparc predict` answers:
an error computed from its file is the figure.
"""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from gsparc.data.schema import LIGHT
from gsparc.data.splits import Fold, Split
from gsparc.models import checkpoint, fitting
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.answer_files import predict_file
from gsparc.prediction.hearing import Hearing
from gsparc.prediction.operating_point import load
from gsparc.runs.align_site import align_to_site
from gsparc.runs.evaluate import evaluate
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

PLACES, STATIONS, FLOOR_DB = 60, 4, -72.0
PHONES = np.array(["Pixel", "Samsung"])
RNG = np.random.default_rng(0)
AT = np.c_[RNG.uniform(0, 300, (PLACES, 2)), np.full(PLACES, 1.5)]
MASTS = np.c_[RNG.uniform(0, 300, (STATIONS, 2)), np.full(STATIONS, 20.0)]
FAR = np.linalg.norm(AT[:, None] - MASTS, axis=2)
LEVEL = -10 - 28 * np.log10(FAR) + 4 * np.sin(FAR / 40) + RNG.normal(0, 1, FAR.shape)
NONE = np.zeros(0, np.int64)


def powers(kind, listed, silent, devices, runs):
    """Arrays of a drive: lists of the `listed` strongest or all, phones 6 dB apart,
    days in turn.
    """
    phone = np.arange(PLACES) % 2
    level = LEVEL + 6.0 * phone[:, None] * devices
    keep = np.argsort(np.argsort(-level, 1), 1) < listed
    place, station = np.nonzero(keep)
    arrays = {
        "rx_position": AT[place],
        "station": station,
        "station_position": MASTS,
        "station_name": np.array([f"m{i}" for i in range(STATIONS)]),
    }
    values = level[place, station]
    if kind == "rssi_db":
        heard = values > FLOOR_DB if silent else values > -np.inf
        arrays |= {"rssi_db": np.where(heard, values, np.nan)}
        arrays |= {"sensitivity_db": np.array(FLOOR_DB)} if silent else {}
    else:
        arrays["rssi"] = 10 ** (values / 10)
    arrays |= {"device": PHONES[phone[place]]} if devices else {}
    return arrays | ({"run": place % 3} if runs else {})


def fitted(name, data, fold, folder):
    method, _ = fitting.fit_or_resume(
        wrap_per_station(method_class(name)(), data), data, fold, FitContext()
    )
    checkpoint.save(
        folder / "model.ckpt", method, extra=Hearing.from_learned(data, fold.learned()).to_extra()
    )
    return method


def asked(predictor, data, rows, folder, kind="csv"):
    """The file that `gsparc predict` writes of rows (n,)."""
    where = data.moving[rows] + data.site.origin
    table = pd.DataFrame(where, columns=["x", "y", "z"])
    if data.station is not None:
        table["station"] = np.array(data.site.every_station.shown)[data.station[rows]]
    if data.device is not None:
        number = data.device[rows]
        table["device"] = np.where(number < 0, "", np.array(data.site.device_names)[number])
    table.to_csv(folder / "places.csv", index=False)
    predict_file(predictor, folder / "places.csv", folder / f"out.{kind}", overwrite=True)
    return pd.read_csv(folder / "out.csv") if kind == "csv" else np.load(folder / "out.npz")


def require_same(method, data, split, folder, learned=None):
    """The figure, the root mean square of per_sample.csv, and that of predict's file are one."""
    rows = split.folds[0].test
    found = evaluate(method, 1.0, data, split, baselines=[], timed=False, learned=learned)
    unit = "dBW" if data.site.unit == "W" else None  # columns of levels, of powers in watts
    told = asked(load(folder / "model.ckpt", unit=unit), data, rows, folder)
    heard = data.censored_side(rows) == 0
    measured = 10 * np.log10(data.powers(rows)[:, 0])
    links = np.unique(np.c_[data.place[rows], data.station[rows]][heard], axis=0)
    whole = len(links) == len(np.unique(data.place[rows])) * STATIONS
    level = told["rssi_db"] if whole or "heard_db" not in told else told["heard_db"]
    error = (level - measured)[heard]
    np.testing.assert_allclose(found.columns["error_db"][heard], error, atol=2e-6)
    rmse = np.sqrt(np.mean(error**2))
    assert found.facts["test/rmse_db"] == pytest.approx(rmse, abs=1e-6)
    assert np.sqrt(np.nanmean(found.columns["error_db"] ** 2)) == pytest.approx(rmse, abs=1e-6)
    np.testing.assert_allclose(found.columns["predicted_db"], told["rssi_db"], atol=2e-6)
    if not whole and "heard_db" in told:
        plain = (told["rssi_db"] - measured)[heard]
        levels_rmse = found.facts["test/levels_rmse_db"]
        assert levels_rmse == pytest.approx(np.sqrt(np.mean(plain**2)), abs=1e-6)
        np.testing.assert_allclose(found.columns["heard_share"], told["heard_share"], atol=2e-6)
    if "test/rmse_db_with_silent" in found.facts:
        silent = np.maximum((told["rssi_db"] - measured)[~heard], 0)
        both = np.r_[(told["rssi_db"] - measured)[heard], silent]
        expected = np.sqrt(np.mean(both**2))
        assert found.facts["test/rmse_db_with_silent"] == pytest.approx(expected, abs=1e-6)
    return whole


KINDS = [("rssi_db", listed, silent) for listed, silent in product((STATIONS, 2, 1), (False, True))]
CASES = list(product([*KINDS, ("rssi", STATIONS, False)], (False, True), (False, True)))


@pytest.mark.parametrize("case, devices, runs", CASES, ids=str)
def test_the_figure_was_not_of_what_is_answered(tmp_path, case, devices, runs):
    """9.70 dB of lists against a file of all stations, where `predict` and numpy had 3.76."""
    data = from_arrays(powers(*case, devices, runs))
    test = data.place % 3 == 0
    fold = Fold(np.flatnonzero(~test), NONE, np.flatnonzero(test))
    method = fitted("gp", data, fold, tmp_path)
    is_limited = data.censored is not None
    whole = require_same(method, data, Split("own", (fold,)), tmp_path)
    assert whole is not is_limited
    # Another file, of all stations, whose phones are in another order.
    truth = powers(case[0], STATIONS, False, devices, runs)
    if devices:
        truth["device"] = np.where(truth["device"] == "Pixel", "Samsung", "Nokia")
    other = align_to_site(from_arrays(truth), method.site)
    rows = np.arange(len(other))
    learned = (data, Split("own", (fold,)))
    assert require_same(method, other, Split("whole", (Fold(NONE, NONE, rows),)), tmp_path, learned)


@pytest.mark.parametrize(
    "several, runs, nulls", product((False, True), (False, True), (False, True))
)
def test_channels_are_scored_as_they_are_answered(tmp_path, several, runs, nulls):
    """Runs that were not learned from have one phase each, which numpy finds, too."""
    rng, tones = np.random.default_rng(1), 2.4e9 + 1e6 * np.arange(6)
    at = np.c_[rng.uniform(0, 0.5, (PLACES, 2)), np.ones(PLACES)]
    posts = np.array([[4.0, 0, 2], [0, 5, 2]])[: 1 + several]
    far = np.linalg.norm(at[:, None] - posts, axis=2)
    csi = np.exp(-2j * np.pi * far[..., None] * tones / LIGHT) / far[..., None]
    run = np.arange(PLACES) % 3
    csi = csi * np.exp(1j * rng.uniform(0, 6, 3))[run][:, None, None] if runs else csi
    csi[..., 4] = 9.0 if nulls else csi[..., 4]
    arrays = {"rx_position": at, "csi": csi, "frequency_hz": tones, "station_position": posts}
    if not several:
        arrays |= {"csi": csi[:, 0], "tx_position": arrays.pop("station_position")[0]}
    data = from_arrays(arrays | ({"run": run} if runs else {}))
    place = np.arange(PLACES) if data.place is None else data.place
    test = data.run == 2 if runs else place % 3 == 0
    fold = Fold(np.flatnonzero(~test), NONE, np.flatnonzero(test))
    method = fitted("complex_gp", data, fold, tmp_path)
    rows, split = fold.test, Split("own", (fold,))
    found = evaluate(method, 1.0, data, split, baselines=[], timed=False)
    told = asked(load(tmp_path / "model.ckpt"), data, rows, tmp_path, "npz")["csi"][:, 0]
    number = np.zeros(len(rows), int) if data.station is None else data.station[rows]
    of_row = np.flatnonzero(test) if not several else place[rows]
    truth = csi[of_row, number]
    real = ~np.isnan(told[0])
    assert (~real).tolist() == [nulls and tone == 4 for tone in range(6)]
    told, truth = told[:, real], truth[:, real]
    if runs:
        overlap = (told.conj() * truth).sum()
        told = told * overlap / abs(overlap)
    nmse = (np.abs(told - truth) ** 2).sum() / (np.abs(truth) ** 2).sum()
    assert found.facts["test/nmse"] == pytest.approx(nmse, rel=1e-5)
