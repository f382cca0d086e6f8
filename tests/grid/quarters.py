"""What maps and plans say of quarters that nobody walked, beside what was measured there.

python tests/grid/quarters.py shares FOLDER cbrs powder wifine plane >> docs/results/maps/shares.csv
python tests/grid/quarters.py shares FOLDER town0 town1 >> docs/results/maps/shares.csv
python tests/grid/quarters.py gains FOLDER cbrs powder >> docs/results/maps/gains.csv

A quarter is half of either half of the places, so that each has as many. FOLDER keeps the models.
"""

import csv
import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import numpy as np
from releases import real
from scipy.linalg import cholesky
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

import gsparc
from gsparc.apps.maps.covered import covered_between
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.planning import plan_measurements
from gsparc.apps.maps.promise import (
    Promise,
    PromiseSettings,
    gather_promise,
    number_quarters,
    read_promise,
)
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.own import read_any
from gsparc.models import checkpoint
from gsparc.models.fitting import fit_or_resume
from gsparc.models.gsparc import Gsparc
from gsparc.models.method import Method
from gsparc.models.per_station import wrap_per_station
from gsparc.prediction.left_out import Learned, predict_rows
from gsparc.prediction.levels import measured_levels, predicted_levels
from gsparc.prediction.predictor import Predictor
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

SQUARES = 60  # along the longer side of a site
COVERED = (0.5, 0.75)  # shares of all places, covered at the levels that are tried
STOPS = 20
POINTS = 6  # access points that are heard most, of lists of very many
SIDE, SHADOW_M, PLACES = np.array([800.0, 600.0]), 60.0, 500  # of simulated towns
MASTS = np.array([[250.0, 200, 25], [500, 420, 25], [620, 120, 25]])


def town(seed: int) -> Measurements:
    """Three cells whose shadows share terrain, 6 dB over 60 m, and a slope that no law knows."""
    rng = np.random.default_rng([11, seed])
    place = np.column_stack([rng.uniform(0, 1, (PLACES, 2)) * SIDE, np.full(PLACES, 1.5)])
    root = cholesky(np.exp(-cdist(place, place) / SHADOW_M) + 1e-6 * np.eye(PLACES), lower=True)
    terrain, own = root @ rng.normal(size=(PLACES, 1)), root @ rng.normal(size=(PLACES, 3))
    slope = ((place[:, :2] / SIDE - 0.5) @ rng.normal(0, 6, 2))[:, None]
    level = -30 - 35 * np.log10(cdist(place, MASTS)) + 4 * terrain + 4.5 * own + slope
    level += rng.normal(0, 2, 3) + rng.normal(0, 2, level.shape)
    names = np.array(["west", "north", "east"])
    arrays = {"rx_position": place, "station_position": MASTS, "station_name": names}
    return from_arrays({**arrays, "rssi_db": level}, {"name": f"town{seed}"})


def campus() -> Measurements:
    """Every third square of 4 m of the CBRS campus."""
    data = read_any(real("cbrs") / "mast1.csv", stations_file=real("cbrs") / "cells.csv").data
    square = (data.moving[:, -3:-1] / 4).round().astype(int) @ np.array([1, 100_003])
    return data.subset(np.flatnonzero(square % 3 == 0))


def streets() -> Measurements:
    """Every sixth place of POWDER, heard by twelve stations."""
    data = read_any(real("real/powder-rss-462mhz.npz")).data
    number = np.unique(data.moving[:, -3:-1], axis=0, return_inverse=True)[1].reshape(-1)
    return data.subset(np.flatnonzero(number % 6 == 0))


def listed(name: str, place: str, level: str) -> Measurements:
    """Lists of access points, whose places nobody knows: of those that are heard most."""
    with np.load(real(name)) as stored:
        levels, places = stored[level], stored[place]
    most = np.argsort(-np.isfinite(levels).sum(0))[:POINTS]
    arrays = {"rx_position": places, "rssi_db": levels[:, most]}
    arrays |= {"station_name": np.array([f"p{number}" for number in most])}
    return from_arrays({**arrays, "station_position": np.full((POINTS, 3), np.nan)}, {"name": name})


def plane() -> Measurements:
    """A plane of 1.25 m, every tenth row; faults are left out as its page says."""
    with np.load(real("real/techtile-power-reci-rf-1.npz")) as stored:
        rows = np.flatnonzero(stored["rssi_db"] > -75)[::10]
        arrays = {"rx_position": stored["rx_position"][rows], "rssi_db": stored["rssi_db"][rows]}
    return from_arrays({**arrays, "tx_position": np.array([4.0, 2, 2.4])}, {"name": "plane"})


def read(name: str) -> Measurements:
    """The data set of a name."""
    if name.startswith("town"):
        return town(int(name[4:]))
    made = {
        "cbrs": campus,
        "powder": streets,
        "wifine": lambda: listed("locate/wifine-floor4.npz", "position", "rss_dbm"),
        "library": lambda: listed("change/library-months.npz", "position", "rss_dbm"),
        "plane": plane,
    }
    return made[name]()


def fit(data: Measurements, rows: np.ndarray, context: FitContext) -> Method:
    """The default model of rows (n,)."""
    fold = Fold(rows, rows[:0], rows[:0])
    return fit_or_resume(wrap_per_station(Gsparc(), data), data, fold, context)[0]


def learned(
    data: Measurements, rows: np.ndarray, file: Path, **how: int
) -> tuple[Predictor, Promise]:
    """A model of rows (n,) with its promise, from its file where it is there; `how`: see
    `PromiseSettings`.
    """
    if not file.is_file():
        fold = Fold(rows, rows[:0], rows[:0])
        context = FitContext(file.parent, stations="together")
        method = fit(data, rows, context)
        model = Learned(method, Gsparc(), data, fold, context)
        promise = gather_promise(model, PromiseSettings(**how))
        checkpoint.save(file, method)
        promise.store(file)
    predictor = gsparc.load(file)
    promise = read_promise(predictor.extra)
    assert promise is not None
    return predictor, promise


def quarters(name: str, folder: Path) -> Iterator[tuple]:
    """Data, and of each quarter its number, what was learned without it and its rows."""
    data = read(name)
    heard = np.flatnonzero((data.censored_side() == 0) & np.isfinite(data.powers()[:, 0]))
    number = number_quarters(data.moving)
    for quarter in [int(name[4:]) % 4] if name.startswith("town") else range(4):
        rows = np.flatnonzero(number != quarter)
        told = learned(data, rows, folder / f"{name}-{quarter}.ckpt")
        yield data, quarter, told, heard[number[heard] == quarter]


def squares_of(places: np.ndarray, step: float, path: Path) -> Path:
    """A GeoJSON file of the squares (n, 2) that places lie in."""
    low = np.unique(np.floor(places / step), axis=0) * step
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * step
    path.write_text(
        json.dumps(
            {"type": "MultiPolygon", "coordinates": [[(at + corners).tolist()] for at in low]}
        )
    )
    return path


def shares(name: str, folder: Path) -> Iterator[tuple]:
    """Share of a quarter's walked squares that is covered: said, its interval, measured there, of
    squares that are not refused; share of places refused; whether the interval holds.

    A square counts by the share of its places whose strongest cell reaches the level.
    """
    for data, quarter, (predictor, promise), rows in quarters(name, folder):
        step = float(np.ptp(data.moving[:, -3:-1], axis=0).max()) / SQUARES
        place, best = strongest(data, rows)
        every = strongest(data, np.arange(len(data)))[1]
        place = place + data.site.origin[:2]
        area = squares_of(place, step, folder / f"{name}-{quarter}.geojson")
        predictor.site = replace(predictor.site, georeference=None)
        for share in COVERED:
            level = float(np.quantile(every[np.isfinite(every)], 1 - share).round())
            field = predict_map(predictor, area, step_m=step, threshold_db=level, promise=promise)
            at = tuple(
                np.abs(axis - place[:, i, None]).argmin(1)
                for i, axis in ((1, field.grid.y), (0, field.grid.x))
            )
            square = at[0] * len(field.grid.x) + at[1]
            known = ~field.refused.reshape(-1)[square]
            count = np.maximum(np.bincount(square), 1)
            weight = 1 / count[square]  # of a place: squares count alike
            true = float(np.average(best >= level, weights=weight))
            of_known = float(np.average((best >= level)[known], weights=weight[known]))
            low, high = covered_between(field, predictor, promise)
            said, refused = 1 - np.nanmean(field.outage), 1 - known.mean()
            figures = (said, low, high, true, of_known, refused)
            held = int(low <= true <= high)
            yield (name, quarter, level, *(round(float(v), 4) for v in figures), held)


def strongest(data: Measurements, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local places (n, 2) of rows, and the strongest level measured at each (n,) [dB]."""
    place, which = np.unique(data.moving[rows, -3:-1], axis=0, return_inverse=True)
    level, side = measured_levels(data, rows)
    best = np.full(len(place), -np.inf)
    heard = np.isfinite(level) & (side == 0)
    np.maximum.at(best, which.reshape(-1)[heard], level[heard])
    return place, best


def gains(name: str, folder: Path) -> Iterator[tuple]:
    """Error of a quarter [dB]: expected now and after `STOPS` places; measured before and after.

    Then the same after as many places at random, and the least distance between planned ones [m].
    """
    for data, quarter, (predictor, promise), rows in quarters(name, folder):
        local = np.unique(data.moving[rows, -3:-1], axis=0)
        place = local + data.site.origin[:2]
        step = float(np.ptp(data.moving[:, -3:-1], axis=0).max()) / SQUARES
        area = squares_of(place, step, folder / f"{name}-{quarter}.geojson")
        predictor.site = replace(predictor.site, georeference=None)
        plan = plan_measurements(
            predictor, STOPS, area, walkable=area, promise=promise, route=False, goal="all"
        )
        near = np.unique(cKDTree(place).query(plan.places[:, :2])[1])
        drawn = np.random.default_rng(quarter).permutation(len(place))[: len(near)]
        had = []
        where = cKDTree(local).query(data.moving[rows, -3:-1])[1]
        out = ~np.isin(where, np.concatenate([near, drawn]))
        base = np.flatnonzero(number_quarters(data.moving) != quarter)
        for stops in (near[:0], near, drawn):
            more = np.sort(np.concatenate([base, rows[np.isin(where, stops)]]))
            method = fit(data, more, FitContext(folder, stations="together"))
            said = predict_rows(method, data, rows[out])
            level = predicted_levels(said, data.site.kind, data.site.target_scale)[0]
            error = level - measured_levels(data, rows[out])[0]
            had.append(float(np.sqrt(np.nanmean(error**2))))
        apart = cKDTree(plan.places[:, :2]).query(plan.places[:, :2], k=2)[0][:, 1].min()
        figures = (plan.before_db, plan.after_db, *had, apart)
        vain = int(bool(plan.in_vain))
        yield (name, quarter, *(round(float(v), 2) for v in figures), vain)


PARTS = {"shares": shares, "gains": gains}

if __name__ == "__main__":
    logging.disable(logging.WARNING)
    part, folder, *names = sys.argv[1:]
    for name in names:
        rows = PARTS[part](name, Path(folder))
        csv.writer(sys.stdout, lineterminator="\n").writerows(rows)
        sys.stdout.flush()
