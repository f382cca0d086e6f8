"""How often maps keep their promise on measured sets, and what planned measurements save.

python bench/maps.py promise plane FILE gsparc 0 1 2 >> promise.csv    # draws 0, 1 and 2
python bench/maps.py campaign plane FILE 0 1 2 >> campaign.csv; room - 0 1 2 for a simulated room
python bench/maps.py table campaign.csv
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.load import datamodule, split_for
from gsparc.data.own import from_arrays
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, SplitSettings
from gsparc.maps.covariance import ErrorCovariance, posterior
from gsparc.maps.intervals import coverage_of, held
from gsparc.maps.levels import measured
from gsparc.maps.planning import greedy
from gsparc.maps.promise import PromiseSettings, answerable, evidence_of, gather, predict_rows
from gsparc.maps.route import Tour
from gsparc.methods.method import FitContext, Method
from gsparc.methods.per_station import PerStation, for_links
from gsparc.methods.registry import method_class
from gsparc.simulate.shoebox import Room, trace

STATIONS = ["cbrssdr1-hospital-comp", "garage-nuc2-b210", "law73-nuc2-b210"]
POOL, MOST = 1200, 8  # places of a campaign, and how often a twentieth of them is measured

SETS = {  # settings of the dataset, side of held-out blocks [m]
    "plane": ({"name": "own", "min_rssi_db": -75, "max_rows": 3000}, 0.3),
    "city": ({"name": "powder", "max_rows": 800}, 300.0),
    "three": ({"name": "powder", "max_rows": 1200, "stations": STATIONS}, 300.0),
    "hall": ({"name": "ble"}, 4.0),
}


def load(name: str, file: str) -> Measurements:
    """The set called so."""
    return datamodule({**SETS[name][0], "file": file}).measurements


def make(name: str) -> Method:
    """An unfitted method; the field with what `conf/model/gsparc.yaml` sets."""
    if name != "gsparc":
        return method_class(name)()
    from hydra import compose, initialize_config_module

    from gsparc.methods.registry import build

    with initialize_config_module("gsparc.conf", version_base="1.3"):
        config = compose("train", overrides=["model=gsparc", "model.steps=0"])
    return build(config.model)


def promise(name: str, file: str, method: str, draws: list[int], folds: int = 4) -> None:
    """A line of each draw: share of held-out blocks' rows inside, widths, and the model's own."""
    data, side = load(name, file), SETS[name][1]
    for draw in draws:
        began = time.perf_counter()
        split = {"name": "blocks", "side_m": side, "seed": draw, "share": 0.2}
        fold = split_for(split, data).folds[0]
        context = FitContext(
            budget_s=30.0, budget_clock="processor", split=SplitSettings("blocks", side_m=side)
        )
        fitted = for_links(lambda: make(method), data)
        fitted.fit(data, fold, context)
        fold = answerable(fitted, data, fold)
        trained = time.perf_counter() - began
        settings = PromiseSettings(folds=folds, seed=draw, block_m=side / 2)
        known = gather(fitted, lambda: make(method), data, fold, settings, context)
        found = evidence_of(fitted, data, fold, np.zeros(len(fold.test), np.int64))
        inside, width = held(known.calibration(), found)
        kept = coverage_of(found, inside, width, np.isfinite(width), 0, 0.9)
        rmse = np.sqrt(np.mean((found.level_db - found.mean_db) ** 2))
        values = (kept.share, kept.width_db, kept.reached, kept.own_share, kept.own_width_db, rmse)
        spent = f"{trained:.1f},{time.perf_counter() - began - trained:.1f}"
        said = ",".join(f"{value:.4f}" for value in values)
        sys.stdout.write(f"{name},{method},{draw},{kept.rows},{said},{spent}\n")
        sys.stdout.flush()


def room(seed: int) -> Measurements:
    """Powers at 1,200 places of a simulated room of 8 x 6 m, 300 MHz, reflections of two bounces."""
    rng = np.random.default_rng(seed)
    shape = Room.uniform((8.0, 6.0, 2.6), -0.6)
    place = np.column_stack([rng.uniform(0.2, [7.8, 5.8], (1200, 2)), np.full(1200, 1.2)])
    still = np.array([1.5, 1.2, 2.2])
    power = 20 * np.log10(np.abs(trace(shape, still, place, np.array([3.0e8]), max_order=2).csi[:, 0, 0]))
    noisy = power + rng.normal(size=len(power))
    return from_arrays({"rx_position": place, "tx_position": still, "rssi_db": noisy})


def campaign(name: str, data: Measurements, draws: list[int]) -> None:
    """A line of each strategy and number of measurements: rmse [dB] at places that are never measured."""
    numbers = np.arange(len(data)) if data.place is None else np.unique(data.place, return_inverse=True)[1]
    where = np.array([data.moving[np.flatnonzero(numbers == n)[0]] for n in range(numbers.max() + 1)])
    for draw in draws:
        order = np.random.default_rng(draw).permutation(len(where))[:POOL]
        square, first = _squares(where[order], len(order) // 5)
        test, pool = order[first], np.delete(order, first)  # of the area: one place in each square
        start = len(order) // 20
        for strategy in ("ours", "variance", "farthest", "grid", "random"):
            chosen = list(range(start))  # of the pool
            while True:
                rows = np.flatnonzero(np.isin(numbers, pool[chosen]))
                asked = np.flatnonzero(np.isin(numbers, test))
                fold = Fold(rows, rows[:0], asked)
                method = for_links(method_class("gp"), data)
                method.fit(data, fold, FitContext())
                mean, _ = predict_rows(method, data, asked)
                level, _ = measured(data, asked)
                rmse = float(np.sqrt(np.nanmean((level - mean) ** 2)))
                sys.stdout.write(f"{name},{strategy},{draw},{len(chosen)},{rmse:.4f}\n")
                sys.stdout.flush()
                if len(chosen) >= MOST * start:
                    break
                chosen = chosen + _next(strategy, method, where[pool], square, chosen, start, draw)


def _next(
    strategy: str,
    method: Method,
    places: np.ndarray,
    squares: np.ndarray,
    chosen: list[int],
    count: int,
    draw: int,
) -> list[int]:
    """So many more of the pool's places (n, 3), for the error at the middles of squares (m, 3)."""
    free = np.ones(len(places), bool)
    free[chosen] = False
    if strategy == "random":
        return np.random.default_rng([draw, len(chosen)]).permutation(np.flatnonzero(free))[:count].tolist()
    if strategy in ("farthest", "grid"):
        nodes = _lattice(places, count) if strategy == "grid" else [None] * count
        known, found = list(chosen), []
        for node in nodes:
            far = (
                cKDTree(places[known]).query(places)[0]
                if node is None
                else -np.hypot(*(places[:, :2] - node).T)
            )
            best = int(np.where(free, far, -np.inf).argmax())
            free[best] = False
            known.append(best)
            found.append(best)
        return found
    copies = [copy for _, copy in method] if isinstance(method, PerStation) else [method]
    unknown = []
    for copy in copies:
        process = copy.process()
        noise = process.kernel.amplitude * process.kernel.noise
        every = np.concatenate([places, squares]) if strategy == "ours" else places
        unknown.append(ErrorCovariance(posterior(process, every), noise, np.ones(len(every))))
    if strategy == "ours":
        wanted = np.arange(len(every)) >= len(places)
        free = np.append(free, np.zeros(len(squares), bool))
        return greedy(unknown, free, wanted, every, count, 0.0, Tour(None, None))[0]
    found = []
    for _ in range(count):
        spread = np.sum([one.covariance.diagonal() for one in unknown], axis=0)
        best = int(np.where(free, spread, -np.inf).argmax())
        for one in unknown:
            one.measured(best)
        free[best] = False
        found.append(best)
    return found


def _squares(places: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Middles (m, 3) of squares of floor that hold places, about `count`, and the first place of each."""
    low, extent = places[:, :2].min(0), np.ptp(places[:, :2], axis=0)
    side = float(np.sqrt(extent.prod() / count))
    while True:
        square, first = np.unique(np.floor((places[:, :2] - low) / side), axis=0, return_index=True)
        if len(first) >= 0.8 * count or len(first) > len(places) // 3:
            break
        side *= 0.9
    middle = low + (square + 0.5) * side
    return np.column_stack([middle, np.full(len(middle), places[:, 2].mean())]), first


def _lattice(places: np.ndarray, count: int) -> list[np.ndarray]:
    """Nodes (2,) of a regular lattice over the places' box, `count` of them, turned by where it starts."""
    low, high = places[:, :2].min(0), places[:, :2].max(0)
    across = max(1, round(float(np.sqrt(count * (high - low)[0] / (high - low)[1]))))
    down = -(-count // across)
    x, y = (np.linspace(a, b, 2 * n + 1)[1::2] for a, b, n in zip(low, high, (across, down), strict=True))
    return list(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)[:count])


def table(file: str) -> None:
    """Of a campaign's lines: mean rmse by number measured, and how many fewer than at random do as well."""
    found: dict[tuple[str, str], dict[int, dict[int, float]]] = {}
    for line in Path(file).read_text().split():
        name, strategy, draw, count, rmse = line.split(",")
        found.setdefault((name, strategy), {}).setdefault(int(draw), {})[int(count)] = float(rmse)
    for name in sorted({name for name, _ in found}):
        whole = {strategy: draws for (of, strategy), draws in found.items() if of == name}
        most = max(len(curve) for draws in whole.values() for curve in draws.values())
        full = [{d for d, curve in draws.items() if len(curve) == most} for draws in whole.values()]
        common = sorted(set.intersection(*full))
        if not common:
            continue
        counts = np.array(sorted(whole["random"][common[0]]))
        mean = {
            s: np.mean([[draws[d][n] for n in counts] for d in common], axis=0) for s, draws in whole.items()
        }
        for strategy, curve in mean.items():
            saved = []
            for last in (most // 2, most - 1):  # numbers that random needs for its rmse there
                reached = np.flatnonzero(curve <= mean["random"][last])
                if not len(reached):
                    saved.append("never")
                    continue
                k = max(int(reached[0]), 1)
                pair = slice(k - 1, k + 1)
                needed = np.interp(-mean["random"][last], -curve[pair], counts[pair])
                saved.append(f"{1 - needed / counts[last]:+.0%}")
            rmse = " ".join(f"{value:.2f}" for value in curve)
            sys.stdout.write(f"{name} {strategy}, {len(common)} draws: {rmse}; fewer {' and '.join(saved)}\n")


if __name__ == "__main__":
    kind, which, where, *rest = [*sys.argv[1:], ""]
    rest = [one for one in rest if one]
    if kind == "promise":
        promise(which, where, rest[0], [int(one) for one in rest[1:]])
    elif kind == "table":
        table(which)
    elif kind == "campaign":
        for one in map(int, rest):
            campaign(which, room(one) if which == "room" else load(which, where), [one])
