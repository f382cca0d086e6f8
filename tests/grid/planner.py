"""What a planner is told of simulated networks, beside their truth, by seeds;
FOLDER keeps their models.

python tests/grid/planner.py covered FOLDER 0 1 2 >> docs/results/maps/covered.csv
python tests/grid/planner.py inside FOLDER 910 911 >> docs/results/maps/inside.csv
python tests/grid/planner.py planned FOLDER 5100 5101 >> docs/results/maps/planned.csv
python tests/grid/planner.py azimuths FOLDER 10 11 >> docs/results/maps/azimuths.csv
python tests/grid/planner.py off FOLDER 801 802 >> docs/results/maps/off.csv

BUILT=1 takes networks with buildings alone, `planned` always.
"""

import csv
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import numpy as np
from networks import BLOCK_M, NOISE_DB, Network, draw_network
from quarters import fit, learned
from scipy.spatial import cKDTree
from scipy.special import ndtr

import gsparc
from gsparc.apps.maps import planning
from gsparc.apps.maps.covered import covered_between
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.planning import coarse_grid
from gsparc.apps.maps.promise import Promise
from gsparc.apps.maps.strongest import outage_probability
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.by_station import unlisted_stations
from gsparc.evaluation.scores import score_methods
from gsparc.models import checkpoint
from gsparc.models.powers.together import network as network_learning
from gsparc.models.powers.together.network import check_azimuths
from gsparc.prediction.levels import joint_levels
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import to_local
from gsparc.processes.uncertainty import half_width
from gsparc.runs.align_site import align_to_site
from gsparc.training.context import FitContext

LISTED, MOMENTS, EVEN, STEP_M, AREA = 6, 350, 1000, 50.0, (250.0, 250.0, 2250.0, 2250.0)
LEAST_LISTS = 20
FOLDS, STOPS = 2, (40, 150)  # of promises; places that a plan sends one to
PLANNED = 400, 450  # places that plans weigh, and choose from
SHARES = (0.9, 0.75, 0.5)  # of the places asked for, covered at the levels that are tried


def town(seed: int, buildings: bool, stops: np.ndarray | None = None) -> Network:
    """A network with places asked for: `EVEN` ones, and stops (n, 2) where a plan may send one."""
    even = np.random.default_rng(seed).uniform(*np.reshape(AREA, (2, 2)), (EVEN, 2))
    stops = coarse_grid(None, AREA, 1.5).places()[:, :2] if stops is None else stops
    return draw_network(seed, 0, MOMENTS, np.concatenate([even, stops]), buildings)


def networked(one: Network, file: Path) -> tuple[Predictor, Promise]:
    """A model of all lists with its promise, from its file where it is there."""
    data = one.data(LISTED)
    return learned(data, np.arange(len(data)), file, folds=FOLDS)


def covered(seed: int, buildings: bool, folder: Path) -> Iterator[tuple]:
    """Share promised with its interval, at places asked outdoors, true there, true at all,
    share refused.
    """
    one = town(seed, buildings)
    predictor, promise = networked(one, folder / f"{seed}-{buildings}.ckpt")
    low, high = (
        np.maximum(one.moment[:, :2].min(0), AREA[:2]),
        np.minimum(one.moment[:, :2].max(0), AREA[2:]),
    )
    even = ((one.asked[:, :2] > low) & (one.asked[:, :2] < high)).all(1) & (
        np.arange(len(one.asked)) < EVEN
    )
    places, best, out = one.asked[even], one.truth[even].max(1), ~one.indoors[even]
    for level in np.quantile(best[out], 1 - np.array(SHARES)).round():
        field = predict_map(
            predictor, [*low, *high], step_m=STEP_M, threshold_db=level, promise=promise
        )
        at = tuple(
            np.abs(axis - places[:, i, None]).argmin(1)
            for i, axis in ((1, field.grid.y), (0, field.grid.x))
        )
        said, known = 1 - field.outage[at], ~field.refused[at]
        ends = covered_between(field, predictor, promise)
        shares = (
            said[known & out].mean(),
            (best >= level)[known & out].mean(),
            (best >= level)[known].mean(),
        )
        figures = (1 - np.nanmean(field.outage), *ends, *shares, 1 - known.mean())
        yield (seed, int(buildings), level, *(round(float(v), 4) for v in figures))


def inside(seed: int, buildings: bool, folder: Path) -> Iterator[tuple]:
    """Shares of 90 % intervals of `predict`, outdoors, that hold the strongest cell, all;
    refused of both.
    """
    one = town(seed, buildings)
    predictor, promise = networked(one, folder / f"{seed}-{buildings}.ckpt")
    places, cells = one.asked[:EVEN][~one.indoors[:EVEN]], np.arange(len(one.place))
    truth = one.truth[:EVEN][~one.indoors[:EVEN]]
    level, spread, _ = np.moveaxis(joint_levels(predictor, places, cells), 1, 0)
    asked = (
        np.repeat(to_local(predictor.site, places, None), len(cells), 0),
        np.tile(cells, len(places)),
    )
    error = promise.expected_errors(*asked, spread.reshape(-1)).reshape(level.shape)
    best = np.arange(len(places)), level.argmax(1)
    figures = []
    for chosen in (best, np.s_[:]):
        held, known = (
            np.abs(level - truth)[chosen] < half_width(0.9) * error[chosen],
            error[chosen] > 0,
        )
        figures += [held[known].mean(), 1 - known.mean()]
    yield (seed, int(buildings), *(round(float(v), 4) for v in figures))


def planned(seed: int, buildings: bool, folder: Path) -> Iterator[tuple]:
    """After `STOPS` more places in streets, outdoors: errors of the strongest level,
    of all cells [dB].

    Share misjudged at a level that three quarters have,
    and error of the share that is predicted to.
    """
    streets, lines = folder / f"streets{seed}.geojson", np.arange(AREA[0], AREA[2] + 1, BLOCK_M)
    ways = [[[c, AREA[1]], [c, AREA[3]]] for c in lines] + [
        [[AREA[0], c], [AREA[2], c]] for c in lines
    ]
    streets.write_text(json.dumps({"type": "MultiLineString", "coordinates": ways}))
    planning.coarse_grid, planning.CANDIDATES = partial(coarse_grid, count=PLANNED[0]), PLANNED[1]
    grid = planning.coarse_grid(None, AREA, 1.5)
    stops = planning.walkable_places(streets, grid)[0][:, :2]
    one = town(seed, buildings, stops)
    predictor, promise = networked(one, folder / f"{seed}-{buildings}-streets.ckpt")
    rng, out, every = np.random.default_rng(seed), ~one.indoors[:EVEN], np.arange(len(one.place))
    true = one.truth[:EVEN][out]
    level = float(np.quantile(true.max(1), 0.25).round())
    most = max(STOPS)
    ways = {"before": [], "random": rng.permutation(len(stops))[:most], "farthest": []}
    far = cKDTree(one.moment[:, :2]).query(stops)[0]
    while len(ways["farthest"]) < most:
        ways["farthest"].append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(stops - stops[far.argmax()], axis=1))
    for name, threshold in {"strongest": None, "covered": level}.items():
        found = planning.plan_measurements(
            predictor,
            most,
            AREA,
            height_m=1.5,
            threshold_db=threshold,
            promise=promise,
            route=False,
            walkable=streets,
        )
        apart, ways[name] = cKDTree(stops).query(found.places[:, :2])
        assert apart.max() < 1.0
    heard = one.truth[EVEN:] + rng.normal(0, NOISE_DB, (len(stops), len(every)))
    for name, count in [("before", 0), *product([*ways][1:], STOPS)]:
        chosen = np.array(ways[name][:count], int)
        at = np.r_[one.moment, one.asked[EVEN:][chosen]], np.r_[one.measured, heard[chosen]]
        data = replace(one, moment=at[0], measured=at[1]).data(LISTED)
        method = fit(data, np.arange(len(data)), FitContext(folder, stations="together"))
        checkpoint.save(folder / f"again{seed}.ckpt", method)
        said = joint_levels(gsparc.load(folder / f"again{seed}.ckpt"), one.asked[:EVEN][out], every)
        mean, spread, alike = np.moveaxis(said, 1, 0)
        best = mean.argmax(1), np.arange(len(mean))
        below = ndtr((level - mean[best[::-1]]) / spread[best[::-1]])
        share = 1 - outage_probability(mean.T, spread.T, level, alike.T, below).mean()
        errors = mean.max(1) - true.max(1), mean - true
        wrong = ((mean.max(1) >= level) != (true.max(1) >= level)).mean()
        figures = (
            *(np.sqrt((e**2).mean()) for e in errors),
            wrong,
            share - (true.max(1) >= level).mean(),
        )
        yield (seed, name, count, *(round(float(v), 4) for v in figures))


def azimuths(seed: int, buildings: bool, _: Path) -> Iterator[tuple]:
    """Three azimuths wrong by an angle: lists, named, told to [deg]; others: named, of how many;
    untested.
    """
    one = draw_network(seed, 0, 2 * MOMENTS, 20, buildings)
    lists, rng = one.listed(LISTED).sum(0), np.random.default_rng(seed)
    enough = np.flatnonzero(lists >= LEAST_LISTS)
    enough = enough[np.argsort(lists[enough])]
    for angle in (0, 30, 60, 120):
        wrong = [rng.choice(part) for part in np.array_split(enough, 3)] if angle else []
        azimuth = one.azimuth.copy()
        azimuth[wrong] += angle * rng.choice([-1, 1], len(wrong))
        data = replace(one, azimuth=azimuth % 360).data(LISTED)
        names, notes = np.array(data.site.stations.name), check_azimuths(data)
        kinds = (
            [note for note in notes if head in note]
            for head in ("contradicted by", "would not show")
        )
        named, told = (
            dict(re.findall(r"([0-9]+-[0-9]+) (?:\(listed )?([0-9]+)", " ".join(kind)))
            for kind in kinds
        )
        named, untold = np.isin(names, [*named]), np.isin(names, [*told])
        false = np.delete(named, wrong).sum(), len(names) - len(wrong), untold.sum()
        for t in wrong or [-1]:
            figures = (lists[t], int(named[t]), told.get(names[t], "")) if wrong else ("", "", "")
            yield (seed, int(buildings), angle, *figures, *false)


def off(seed: int, buildings: bool, folder: Path) -> Iterator[tuple]:
    """Cells of a site that was off in a second drive: moments expected, named, chance;
    others named.
    """
    one = draw_network(seed, 0, 1000, 10, buildings)
    first, second = (slice(0, 600), slice(600, 1000))
    data = replace(one, moment=one.moment[first], measured=one.measured[first]).data(LISTED)
    every = np.arange(len(data))
    method = fit(data, every, FitContext(folder, stations="together"))
    taught = Split("all", (Fold(every, every[:0], every[:0]),))
    for site in (None, *range(0, 10, 2)):
        measured, cells = (
            one.measured[second].copy(),
            [] if site is None else [3 * site + k for k in range(3)],
        )
        measured[:, cells] = -400.0
        later = replace(one, moment=one.moment[second], measured=measured).data(LISTED)
        judged = align_to_site(later, data.site)
        rows = np.arange(len(judged))
        whole = Split("whole", (Fold(rows[:0], rows[:0], rows),))
        scores = score_methods([method], judged, whole, learned=(data, taught))
        named = unlisted_stations(scores, judged)
        others = int((~named.index.isin(cells)).sum())
        shares = scores.never_listed.groupby("station").share.sum()
        for cell in cells or [-1]:
            chance = f"{named.chance[cell]:.1e}" if cell in named.index else ""
            expected = round(float(shares.get(cell, 0.0)), 1) if cells else ""
            figures = (expected, int(cell in named.index), chance) if cells else ("", "", "")
            yield (seed, int(buildings), "" if site is None else site, *figures, others)


PARTS = {"off": off, "covered": covered, "inside": inside, "planned": planned, "azimuths": azimuths}

if __name__ == "__main__":
    logging.disable(logging.WARNING)
    # All that are untested, not the first
    network_learning.list_first = lambda names, _: ", ".join(names)
    part, folder, *seeds = sys.argv[1:]
    kinds = (True,) if os.environ.get("BUILT") or part == "planned" else (False, True)
    for seed, buildings in product(map(int, seeds), kinds):
        csv.writer(sys.stdout, lineterminator="\n").writerows(
            PARTS[part](seed, buildings, Path(folder))
        )
        sys.stdout.flush()
