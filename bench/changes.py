"""Maps that are told of later rows, beside what else could be done: docs/results/changes.csv.

    python bench/changes.py [rooms] [networks] [detections] [months] [rounds] [campaigns] [priors]
                            [cells] [seconds] [updates] [kills]

Room and network are simulated here; months of a library and rounds of a garage are looked for in
../shared/data/change. Errors are of places that nobody told of, rmse [dB].
"""

import csv
import logging
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import rasterio
import torch
from scipy.spatial import cKDTree
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

import gsparc
from gsparc.data.query import Query
from gsparc.models import checkpoint
from gsparc.models.updated import map_level
from gsparc.prediction.drift import Watch
from gsparc.prediction.updating import versions_extra
from gsparc.processes.changes import (
    AWAY,
    ERRORS,
    KINDS,
    LEAST,
    NEAR,
    TINY,
    WHOLE,
    LaterRows,
    correct,
    learn,
)
from gsparc.simulate.effects import Effects
from gsparc.simulate.raytracer import Sampling
from gsparc.simulate.scenes.build import build_survey
from gsparc.simulate.scenes.settings import SceneSettings

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
import networks as simulated

MEASURED = Path(__file__).parents[2] / "shared/data/change"
OUT = Path(__file__).parents[1] / "docs/results/changes.csv"
SIDE, STATIONS, KEPT = 40.0, 30, 80
DRAWS, READINGS, BEGINS = 200, 1000, 300
SILENCE = 1e-12  # power of what is heard where nothing arrives [mW]
LISTED, SHADOWING = 6, ("COMMON_DB", "OWN_DB")  # cells in a list; deviations of `simulated`
UPDATES, EACH, KILLS = 100_000, 1000, 20


def field(places, seed, length=8.0):
    """Levels (n,) of a smooth random field with deviation 4 dB."""
    rng = np.random.default_rng(seed)
    waves, phase = rng.normal(size=(60, 2)) * 1.4 / length, rng.uniform(0, 2 * np.pi, 60)
    return 4 * np.sqrt(2 / 60) * np.cos(places[:, :2] @ waves.T + phase).sum(1)


def draw(count, seed, side=SIDE):
    """Places (count, 3) on a floor."""
    return np.c_[np.random.default_rng(seed).uniform(0, side, (count, 2)), np.full(count, 1.5)]


def network(places, seed, later):
    """Levels (n, T) of an office; later a quarter changed power, moved or failed,
    and another phone reads.
    """
    rng = np.random.default_rng(seed)
    posts, shift = rng.uniform(0, SIDE, (STATIONS, 2)), np.zeros(STATIONS)
    fields = np.arange(STATIONS) + 1000 * seed
    if later:
        shift[:4] = rng.normal(0, 8, 4)
        posts[4:7], fields[4:7] = rng.uniform(0, SIDE, (3, 2)), fields[4:7] + 500
        shift[7] = -60
    distance = np.linalg.norm(places[:, None, :2] - posts, axis=2)
    level = (
        -40
        - 30 * np.log10(np.maximum(distance, 1))
        + np.stack([field(places, s) for s in fields], 1)
    )
    level += shift - 3 * later + np.random.default_rng(seed + 7 + later).normal(0, 2.5, level.shape)
    return np.where(level > -95, level, np.nan)


def screened(places, stands=True):
    """Levels (n,) of a room; where `stands` (n,), a screen of 12 dB is before a disc of 4 m."""
    return (
        -60
        + field(places, 1, 4.0)
        - 12 * (stands & (np.linalg.norm(places[:, :2] - 5, axis=1) < 4))
    )


def planned(places, town=1):
    """What a planning tool knows of a town [dBm]."""
    return -40 - 30 * np.log10(np.hypot(*places[:, :2].T) + 10) + 2 * field(places, town, 60.0)


def rmse(predicted, truth):
    """Over what was heard."""
    return round(float(np.sqrt(np.nanmean((predicted - truth) ** 2))), 3)


def judge(name, model, places, levels, told, alone=None):
    """Rows of results of one later survey: told of some places, asked about the others.

    `alone`: other arguments of a model of the places told alone, beside it; None: there is none.
    """
    at, which = np.unique(places, axis=0, return_inverse=True)
    which, static = which.reshape(-1), model.rssi(rx=places)
    miss, order = (
        np.ma.masked_invalid(levels - static),
        np.random.default_rng(0).permutation(len(at)),
    )
    for count in told:
        new = np.isin(which, order[:count])
        began = time.monotonic()
        model.update(rx=places[new], rssi=levels[new])
        seconds = time.monotonic() - began
        ways = {
            "old map": static,
            "updated": model.rssi(rx=places),
            "one constant each, of the places told": static + miss[new].mean(0).filled(0),
            "one constant each, of all later rows": static + miss.mean(0).filled(0),
        }
        if alone is not None:
            trained = gsparc.fit(rx=places[new], rssi=levels[new], **alone)
            ways["trained on the places told"] = trained.rssi(rx=places)
        for way, prediction in ways.items():
            spent = round(seconds, 3) if way == "updated" else ""
            yield name, f"{count} places", way, rmse(prediction[~new], levels[~new]), spent
        model.undo()


def networks():
    """Offices of 30 access points, 120 places before and 100 later; with and without changes."""
    for seed in (1, 2, 3):
        before, later = draw(120, seed), draw(100, 50 + seed)
        unknown = np.full((STATIONS, 3), np.nan)
        fit = {"rx": before, "rssi": network(before, seed, False), "station_position": unknown}
        model = gsparc.fit(**fit, model="gp")
        yield from judge(
            f"office {seed}, changed", model, later, network(later, seed, True), (5, 20)
        )
        yield from judge(
            f"office {seed}, as before", model, later, network(later, seed, False), (5, 20)
        )


def was_and_is(level, *places):
    """Of each places (n, 3): them, and levels (n,) before and later."""
    return [(at, level(at, False), level(at)) for at in places]


def disc():
    """A smooth field, then a screen of 12 dB in a disc of 4 m; rows are in and around it."""
    probes, near = draw(3000, 11, 20.0), draw(4000, 6, 20.0)
    near = near[np.linalg.norm(near[:, :2] - 5, axis=1) < 6]
    return "room", [9.0, 9.0, 2.6], *was_and_is(screened, draw(300, 0, 20.0), near, probes)


def traced(name, moved, effects, counts, apart_m, **facts):
    """A simulated change; rows are nearer than `apart_m` to where it changes 3 dB.

    `counts`: of places asked and of those that rows are drawn from.
    """
    facts |= {"name": name, "carrier_hz": 2.44e9, "bandwidth_hz": 0.0, "subcarriers": 1}
    before, asked, near = (
        build_survey(
            SceneSettings(num_receivers=count, seed=seed, moved=later, **facts), Sampling()
        )
        for count, seed, later in zip((300, *counts), (0, 11, 6), ([], moved, moved), strict=True)
    )

    def level(places, later=True):
        paths = (asked if later else before).engine.trace(places, effects)
        return 10 * np.log10(paths.received_power() + SILENCE)

    told = was_and_is(level, before.places, near.places, asked.places)
    places, was, now = told[1]
    there = cKDTree(places[np.abs(now - was) > 3]).query(places)[0] < apart_m
    told[1] = places[there], was[there], now[there]
    return name, before.engine.transmitter, *told


def cabinet():
    """A shoebox of 14 x 10 m, whose cabinet is moved."""
    room = {
        "size_m": [14.0, 10.0, 3.0],
        "boxes_m": [[[8.0, 2.0, 0.0], [9.0, 4.0, 2.5]]],
        "reflection": -0.5,
    }
    where = {"transmitter_m": [2.0, 5.0, 2.6], "area_m": [[0.3, 0.3], [13.7, 9.7]], "room": room}
    moved = [{"name": "box0", "by_m": [0.0, 4.0, 0.0]}]
    return traced("cabinet", moved, Effects(), (3000, 1000), 0.5, **where)


def building():
    """A town of 180 x 190 m with a mast on a roof, and a building of 37 x 23 x 20 m that is new."""
    where = {"file": str(OUT.parents[2] / "examples/town.osm"), "over": "ground", "open_sky": True}
    mast, area = (
        {"name": "roof", "position_m": [20, 45], "height_m": 3},
        [[-90.0, -75.0], [90.0, 115.0]],
    )
    moved, less = [{"box_m": [[33, 74, 0], [70, 97, 20]]}], Effects(diffuse=False)
    return traced("town", moved, less, (700, 700), 5.0, transmitters=[mast], area_m=area, **where)


def space_time(before, heard, new, told, asked):
    """Levels at places later by scikit-learn's process of space and time, 0 before and 1 later."""
    places, level = (
        np.r_[np.c_[before[:, :2], 0 * heard], np.c_[new[:, :2], 0 * told + 1]],
        np.r_[heard, told],
    )
    kernel = ConstantKernel(20.0) * Matern([3.0, 3.0, 3.0], (0.1, 100.0), nu=1.5) + WhiteKernel(1.0)
    process = GaussianProcessRegressor(kernel, normalize_y=True).fit(places, level)
    return process.predict(np.c_[asked[:, :2], np.ones(len(asked))])


def rooms():
    """One transmitter, 300 rows with 1 dB of noise; then something is moved,
    and rows in and around tell.
    """
    for name, post, (before, was, now), (near, _, values), (probes, static, truth) in (
        one() for one in ROOMS
    ):
        heard = was + np.random.default_rng(2).normal(size=len(before))
        values = values + np.random.default_rng(3).normal(size=len(near))
        changed, right = np.abs(truth - static) > 3, np.abs(now - was) > 3
        fixed = {"tx": post, "model": "gp"}
        model = gsparc.fit(rx=before, rssi=heard, **fixed)
        for count in (5, 10, 20, 50):
            new, levels, ways = (
                near[:count],
                values[:count],
                {"old map": model.rssi(rx=probes)[:, 0]},
            )
            for way, refit in (("updated", False), ("updated, refit=true", True)):
                began = time.process_time()
                model.update(rx=new, rssi=levels, refit=refit)
                seconds = round(time.process_time() - began, 3)
                ways[way] = model.rssi(rx=probes)[:, 0], seconds
                model.undo()
            sets = {
                "all": slice(None),
                "the right rows": ~right,
                "a window of 300": slice(count, None),
            }
            for way, rows in sets.items():
                part = {"rx": np.r_[before[rows], new], "rssi": np.r_[heard[rows], levels]}
                ways[f"retrained on {way}"] = gsparc.fit(**part, **fixed).rssi(rx=probes)[:, 0]
            ways["retrained on the new rows"] = gsparc.fit(rx=new, rssi=levels, **fixed).rssi(
                rx=probes
            )[:, 0]
            ways["space and time"] = space_time(before, heard, new, levels, probes)
            for way, result in ways.items():
                answer, seconds = result if isinstance(result, tuple) else (result, "")
                for part, where in (("where it changed", changed), ("elsewhere", ~changed)):
                    yield (
                        f"{name}, {part}",
                        f"{count} rows",
                        way,
                        rmse(answer[where], truth[where]),
                        seconds,
                    )


def seconds():
    """One row, and 50, told to a model of 5,000 rows with 5,000 kept: the least of ten each."""
    before, new = draw(5000, 0, 20.0), draw(6000, 6, 20.0)
    level, later = (
        -60 + field(at, 1, 4.0) + np.random.default_rng(2).normal(size=len(at))
        for at in (before, new)
    )
    model = gsparc.fit(rx=before, rssi=level, tx=[9.0, 9.0, 2.6], model="gp")
    model.update(rx=new[:5000], rssi=later[:5000], window=5000)
    for count in (1, 50):
        spent = []
        for turn in range(10):
            rows, began = slice(5000 + count * turn, 5000 + count * (turn + 1)), time.process_time()
            model.update(rx=new[rows], rssi=later[rows], window=5000)
            spent.append(1e3 * (time.process_time() - began))
        yield (
            "an update, 5,000 rows kept",
            f"{count} rows",
            ("least of ten [ms]"),
            round(min(spent), 1),
            "",
        )


def readings(kind, seed, count):
    """Rows of one station as they miss a map, whose error is .7 dB and noise 2 dB;
    changed from BEGINS on.
    """
    rng = np.random.default_rng(seed)
    places = np.c_[rng.uniform(-10, 10, (count, 2)), np.zeros(count)]
    later, level = np.arange(count) >= BEGINS, 1.5 * field(places, seed + 1, 5.0)
    missed = 0.175 * field(places, seed, 2.0) + rng.normal(0, 2, count)
    missed -= 6 * (later & (kind == "offset"))
    missed -= 12 * (later & (kind == "local") & (np.linalg.norm(places[:, :2] - 2, axis=1) < 4))
    missed -= np.where(later & (kind == "moved"), level - 1.5 * field(places, seed + 2, 5.0), 0)
    parts = places, level - 60, missed, np.full(count, 0.49), np.full(count, 4.0), np.zeros(count)
    number = torch.arange(count)
    return LaterRows(number, 0 * number, *map(torch.from_numpy, parts), number < 0)


def detections():
    """Alarms of sequences without change, then delays, and what was named, for three kinds."""
    site = SimpleNamespace(every_station=[0], moving_box=np.array([[-10.0, -10, 0], [10, 10, 0]]))

    def alarms(kind, seed, count):
        return Watch.from_site(site).look({0: readings(kind, seed, count)}, 0, 28.0)[0].alarms

    false = sum(len(alarms("none", seed, READINGS)) for seed in range(DRAWS))
    yield "alarms without change", f"{DRAWS} x {READINGS} readings", "e-detector", false, ""
    for kind in ("offset", "local", "moved"):
        found = [alarms(kind, 5000 + seed, BEGINS + 300) for seed in range(DRAWS)]
        first = [next((one for one in each if one.at >= BEGINS), None) for each in found]
        delay = [BEGINS + 300 if one is None else one.at - BEGINS + 1 for one in first]
        names = [one.kind for one in first if one is not None]
        for way, figure in (("median", np.median(delay)), ("90 %", np.quantile(delay, 0.9))):
            yield f"delay, {kind}", f"{DRAWS} sequences", way, float(figure), ""
        yield f"named, {kind}", f"{DRAWS} sequences", "rightly", names.count(kind) / DRAWS, ""


def measured(file, epoch):
    """Months of a library, rounds of a garage: the first learns, later ones tell of 5 places,
    a fifth.
    """
    data = np.load(MEASURED / file)
    places, levels, of = data["position"].astype(float), data["rss_dbm"].astype(float), data[epoch]
    places = np.c_[places, np.full(len(places), 1.5)][:, :3]
    visit, first, at = np.unique(np.c_[of, places], axis=0, return_index=True, return_inverse=True)
    # Several readings of a place in an epoch are their mean.
    sums = [np.zeros((len(visit), levels.shape[1])) for _ in range(2)]
    for total, values in zip(sums, (np.nan_to_num(levels), np.isfinite(levels)), strict=True):
        np.add.at(total, at.reshape(-1), values)
    levels = np.where(sums[1] > 0, sums[0] / np.maximum(sums[1], 1), np.nan)
    places, of = places[first], of[first]
    heard = np.isfinite(levels[of == 1]).sum(0) >= KEPT
    levels, unknown = levels[:, heard], np.full((heard.sum(), 3), np.nan)
    first = {"rx": places[of == 1], "rssi": levels[of == 1], "station_position": unknown}
    model = gsparc.fit(**first, model="gp")
    for number in np.unique(of)[1:]:
        in_epoch = of == number
        fifth = len(np.unique(places[in_epoch], axis=0)) // 5
        yield from judge(f"{epoch} {number}", model, places[in_epoch], levels[in_epoch], (5, fifth))


def campaigns():
    """Powers of a robot at every fourth antenna of a ceiling: a campaign learns,
    the next one tells.
    """
    data = np.load(MEASURED.parent / "real/techtile-csi-920mhz.npz")
    levels = 20 * np.log10(np.abs(np.where(data["mask"], data["csi"], np.nan))[:, ::4])
    places, later = data["tx_position"], data["run"] == "EXP006"
    fixed = {"station_position": data["rx_antenna_position"][::4], "model": "gp"}
    model = gsparc.fit(rx=places[~later], rssi=levels[~later], **fixed)
    yield from judge(
        "EXP005 then EXP006", model, places[later], levels[later], (5, 20, 50, 119), fixed
    )


def judge_maps(axis, cases):
    """Rows of results of maps from before any row, means over towns.

    Args:
        axis: (n,) centres of squares, both ways [m].
        cases: of each town the rows that are known, places and levels (Q, T) that are asked, names
            of stations, and levels (n * n, T) of each map.
    """
    squares, errors, spent = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2), [], 0.0
    step = axis[1] - axis[0]
    how = {"width": len(axis), "height": len(axis), "dtype": "float64", "driver": "GTiff"}
    how["transform"] = rasterio.transform.from_origin(
        axis[0] - step / 2, axis[-1] + step / 2, step, step
    )
    for known, asked, truth, names, maps in cases:
        row = {"no map": rmse(gsparc.fit(**known).rssi(rx=asked), truth)}
        for name, levels in maps.items():
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "map.tif"
                with rasterio.open(file, "w", count=len(names), **how) as raster:
                    raster.write(levels.T.reshape(-1, len(axis), len(axis))[:, ::-1])
                    raster.descriptions = [f"power_db {each_name}".strip() for each_name in names]
                began = time.monotonic()
                found = gsparc.fit(**known, settings={"prior": file})
                spent = max(spent, time.monotonic() - began)
            row[name] = rmse(found.rssi(rx=asked), truth)
            row[f"{name}, alone"] = rmse(levels[cKDTree(squares).query(asked[:, :2])[1]], truth)
        errors.append(row)
    for name in errors[0]:
        ratio = [row[name] / row["no map"] for row in errors]
        yield name, "mean", round(float(np.mean([row[name] for row in errors])), 3), round(spent, 2)
        yield name, "most of no map's", round(max(ratio), 3), round(spent, 2)


def priors():
    """Towns whose planned map misses shadowing, has 6 dB too little, lies 30 m off,
    or is another town's.
    """
    axis = np.arange(5.0, 700, 10)
    squares = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)

    def case(town, count):
        places = draw(count + 400, 100 + town, 600.0) + np.array([50, 50, 0])
        level = planned(places, town) + 0.75 * field(places, town + 20, 30.0)
        level += np.random.default_rng(town).normal(0, 1, len(places))
        survey = {"rx": places[:count], "tx": [0.0, 0, 20], "rssi": level[:count]}
        maps = {
            "misses shadowing": planned(squares, town),
            "6 dB too low": planned(squares, town) - 6,
            "30 m off": planned(squares - [30, 0], town),
            "another town's": planned(squares, town + 50),
        }
        return (
            survey,
            places[count:],
            level[count:, None],
            [""],
            {n: each_map[:, None] for n, each_map in maps.items()},
        )

    for count in (5, 10, 20, 50, 100):
        for name, *figures in judge_maps(axis, (case(town, count) for town in range(1, 7))):
            yield f"six towns, {name}", f"{count} rows", *figures


def cells():
    """Networks with a map of each cell, that misses shadowing, has 6 dB too little,
    or is another town's.
    """
    axis = np.arange(25.0, simulated.SIDE_M, 50)
    squares = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)

    def town(seed, shadows):
        asked = np.r_[squares, np.random.default_rng(seed).uniform(0, simulated.SIDE_M, (250, 2))]
        with patch.multiple(
            simulated, **{one: shadows * getattr(simulated, one) for one in SHADOWING}
        ):
            return simulated.draw_network(seed, 0, 300, asked)

    def case(seed, count):
        one, flat, other = town(seed, 1), town(seed, 0), town(seed + 50, 0)
        known = one.arrays(LISTED)
        heard = np.random.default_rng(seed).permutation(len(one.moment))[: count // LISTED]
        rows = np.isin(np.nonzero(one.listed(LISTED))[0], heard)
        known |= {name: known[name][rows] for name in ("rx_position", "station", "rssi_db")}
        maps = {
            "misses shadowing": flat.truth,
            "6 dB too low": flat.truth - 6,
            "another town's": other.truth,
        }
        maps = {name: level[: len(squares)] for name, level in maps.items()}
        return (
            known,
            one.asked[len(squares) :],
            one.truth[len(squares) :],
            known["station_name"],
            maps,
        )

    for count in (48, 198, 996):
        for name, *figures in judge_maps(axis, (case(seed, count) for seed in range(1, 5))):
            yield f"four networks, {name}", f"{count} rows", *figures


def world():
    """A model of 300 rows of a room, and what later rows (n,) measure at places, by number.

    The screen of `rooms` comes, or goes, after every 10,000 of them.
    """
    before, noise = draw(300, 0, 20.0), np.random.default_rng(2)

    def measure(number, places):
        return screened(places, np.asarray(number) // 10_000 % 2 == 1) + noise.normal(
            size=len(places)
        )

    return gsparc.fit(rx=before, rssi=measure(0, before), tx=[9.0, 9.0, 2.6], model="gp"), measure


def matern(distance, length):
    """Matern-3/2."""
    return (1 + 3**0.5 * distance / length) * np.exp(-(3**0.5) * distance / length)


def solve(belief, rows, level, doubt, apart, among, middle, seen):
    """Level [dB] at a place, at distances `apart` (n,) and `among` (n, n) [m]:
    one plain solve a kind.
    """
    weight, added = (np.asarray(part) for part in belief.of(0))
    mask, result, near = weight >= LEAST, 0.0, matern(apart.min(), belief.extent * AWAY)
    for share, kind in zip(weight, KINDS, strict=True):
        if share < LEAST:
            continue
        covariances = [
            kind.keeps
            * np.sqrt(variance * rows.doubt.numpy())
            * matern(distance, belief.extent * ERRORS)
            + kind.offset**2
            + kind.local**2 * matern(distance, belief.extent * kind.size)
            for variance, distance in ((doubt, apart), (rows.doubt.numpy()[:, None], among))
        ]
        noise = added + (rows.noise + rows.faded).numpy() + TINY
        values = (
            rows.missed.numpy() + (1 - kind.keeps) * rows.level.numpy() - (1 - kind.keeps) * middle
        )
        mean = covariances[0] @ np.linalg.solve(covariances[1] + np.diag(noise), values)
        away = 0.0 if kind.keeps else near + (1 - near) * seen
        mean = (kind.keeps + away) * mean + (1 - away) * level + away * middle
        result += share / weight[mask].sum() * mean
    return result


def updates():
    """A row at a time, many of them: differences to fresh solves, memory and seconds."""
    model, measure = world()
    places, probes = draw(UPDATES, 6, 20.0), torch.from_numpy(draw(20, 11, 20.0))
    levels, query = (
        measure(np.arange(UPDATES), places),
        probes - torch.from_numpy(model.site.origin),
    )
    before = map_level(
        model.method, model.predict_query(Query.from_places(model.site, query.float())), model.site
    )
    worst, few, seconds, alarms, began = {NEAR: 0.0, 1000: 0.0}, [], [], 0, 0.0
    for number in range(UPDATES):
        began = time.process_time()
        alarms += len(model.update(rx=places[[number]], rssi=levels[[number]]).alarms)
        seconds.append(time.process_time() - began)
        if number % EACH != EACH - 1:
            continue
        rows, extent = (
            model.versions[-1].changes.stations[0],
            model.versions[-1].changes.belief.extent,
        )
        means = correct(
            model.versions[-1].changes.belief, 0, rows, query, before.mean, before.doubt
        ).mean
        belief, distances = learn({0: rows}, extent), torch.cdist(query, rows.places).numpy()
        seen = min(np.linalg.norm(np.ptp(rows.places.numpy(), axis=0)) / extent, 1.0) ** WHOLE
        for count in worst if number % (5 * EACH) == 5 * EACH - 1 else (NEAR,):
            for one, distance in enumerate(distances):
                near = np.argsort(distance)[:count]
                part = rows[torch.from_numpy(near)]
                among = torch.cdist(part.places, part.places).numpy()
                fresh = solve(
                    belief,
                    part,
                    float(before.mean[one]),
                    float(before.doubt[one]),
                    distance[near],
                    among,
                    rows.middle.item(),
                    seen,
                )
                worst[count] = max(worst[count], abs(fresh - float(means[one])))
        memory = (
            int(Path("/proc/self/statm").read_text().split()[1])
            * os.sysconf("SC_PAGE_SIZE")
            / 2**20
        )
        few.append(memory)
    name, amount = "a row at a time, 1,000 kept", f"{UPDATES} updates"
    figures = {
        "from a fresh solve of the 64 nearest rows, at most [dB]": worst[NEAR],
        "from a fresh solve of all rows kept, at most [dB]": worst[1000],
        "memory after 1,000 updates [MiB]": few[0],
        "memory at the end [MiB]": few[-1],
        "alarms, of 9 changes": alarms,
        "an update, median [ms]": 1e3 * np.median(seconds),
        "of the last 1,000, median [ms]": 1e3 * np.median(seconds[-EACH:]),
    }
    for way, figure in figures.items():
        yield (
            name,
            amount,
            way,
            float(f"{figure:.3g}"),
            round(sum(seconds)) if way.startswith("an") else "",
        )
    states = []
    for turn in range(10):
        states.append(model.predict(rx=probes.numpy()))
        model.update(rx=places[[turn]], rssi=levels[[turn]])
    same = 0
    for state in states[::-1]:
        model.undo()
        now = model.predict(rx=probes.numpy())
        same += bool((now.mean == state.mean).all() and (now.variance == state.variance).all())
    yield name, "10 updates, then 10 undos", "bit-identical", same, ""


def kills():
    """A process that updates a file, killed at random moments: the file holds the state before,
    or after.
    """
    model, measure = world()
    places, probes, rng = draw(2000, 6, 20.0), draw(20, 11, 20.0), np.random.default_rng(0)
    levels, whole, losses, writes = measure(np.arange(2000), places), 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        file, maps = Path(folder) / "model.ckpt", [model.rssi(rx=probes)]
        checkpoint.save(file, model.method)
        for _ in range(KILLS):
            begins, (heard, says) = len(gsparc.load(file).rows), os.pipe()
            if (child := os.fork()) == 0:
                mine = gsparc.load(file)
                for number in range(begins, len(places)):
                    mine.update(rx=places[[number]], rssi=levels[[number]], window=len(places))
                    checkpoint.update_extra(file, versions_extra(mine.versions), file)
                    os.write(says, b".")
                os._exit(1)
            time.sleep(rng.uniform(0.2, 1.2))
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            os.close(says)
            done, after = begins + len(os.read(heard, 2**16)), gsparc.load(file)
            os.close(heard)
            for number in range(len(maps) - 1, len(after.rows)):
                model.update(rx=places[[number]], rssi=levels[[number]], window=len(places))
                maps.append(model.rssi(rx=probes))
            writes, losses = len(after.rows), losses + (len(after.rows) < done)
            whole += (
                len(after.rows) in (done, done + 1)
                and (after.rssi(rx=probes) == maps[len(after.rows)]).all()
            )
        leftovers = len(list(Path(folder).iterdir())) - 1
    figures = {
        "the state before, or after, bit for bit": int(whole),
        "updates lost that were said to be stored": losses,
        "partial files left": leftovers,
    }
    for way, figure in figures.items():
        yield "killed at random", f"{KILLS} kills, {writes} writes", way, figure, ""


ROOMS = disc, cabinet, building
PARTS = {
    "networks": networks,
    "rooms": rooms,
    "detections": detections,
    "priors": priors,
    "cells": cells,
    "campaigns": campaigns,
    "seconds": seconds,
    "updates": updates,
    "kills": kills,
    "months": lambda: measured("library-months.npz", "month"),
    "rounds": lambda: measured("garage-rounds.npz", "round"),
}

if __name__ == "__main__":
    logging.disable(logging.WARNING)
    for name in sys.argv[1:] or PARTS:
        with OUT.open(newline="") as file:
            rows = {tuple(row[:3]): row for row in csv.reader(file)}
        rows |= {tuple(map(str, row[:3])): row for row in map(list, PARTS[name]())}
        with OUT.open("w", newline="") as file:  # of the same figure the last one
            csv.writer(file, lineterminator="\n").writerows(rows.values())
