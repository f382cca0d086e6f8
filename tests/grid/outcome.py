"""One world trained with defaults beside every plain method that trains on it, and judged."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from campaigns import compose
from worlds import World, arrays

from gsparc.commands.train import Objects, train
from gsparc.data.errors import DataError
from gsparc.data.own import load_own
from gsparc.data.schema import Measurements
from gsparc.evaluation.baseline_cache import baseline, fitting
from gsparc.evaluation.scores import Scores

BEHIND = 0.05  # of the best plain method's error, that ours may be behind
FIGURE = {"spectrum": "mse", "csi": "error_power", "rssi": "error_db"}
FRESH = 5  # seeds that repeat a miss


@dataclass
class Outcome:
    """What a world came to.

    Attributes:
        world, seed: which.
        seconds: of the whole training, baselines and evaluation with it [s].
        fit_s: of the fit [s].
        best: the plain method of least error, its error beside ours; relative to that of zero, or in dB.
        own_error, best_error, allowed: the last is what ours may be behind.
        plain: whether the default came to no more than a plain process.
        refused: what it said instead; then nothing else is known.
    """

    world: str
    seed: int
    seconds: float = 0.0
    fit_s: float = 0.0
    best: str = ""
    own_error: float = np.nan
    best_error: float = np.nan
    allowed: float = np.nan
    plain: bool = False
    model: str = ""
    refused: str = ""

    @property
    def behind(self) -> bool:
        """Whether the default lost."""
        return bool(self.own_error - self.best_error > self.allowed)

    def line(self) -> str:
        """For a file of results."""
        return json.dumps(asdict(self))


def run(world: World, seed: int, folder: Path, more: tuple[str, ...] = ()) -> tuple[Outcome, Objects | None]:
    """Train and judge; files go to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    file, started = folder / "own.npz", time.perf_counter()
    np.savez(file, **arrays(world, seed))
    found = Outcome(world.name, seed)
    overrides = ["dataset=own", f"dataset.file='{file}'", "model=gsparc", f"split={world.split}", "logger=none", *more]
    try:
        facts, objects = train(compose(*overrides, "baselines=[zero]"), folder / "run")
    except (ValueError, DataError) as error:
        found.refused, found.seconds = str(error), time.perf_counter() - started
        return found, None
    found.fit_s, method = float(facts["time/train_s"]), objects.methods[0]
    found.model = f"{facts['model/effects']} init={facts.get('model/init')} n={method.size()}"
    found.plain = method.size() == 0
    own = objects.evaluation.columns
    split, data = objects.split, objects.data
    errors = {name: _errors(baseline(name, data, split).scores) for name in _plain(data, split)}
    mine = own[FIGURE[data.site.kind]]
    mine = mine**2 if data.site.kind == "rssi" else mine
    unit = _unit(world, data, split.folds[0].test)
    usable = np.isfinite(mine)
    means = {name: float(np.mean(each[usable])) for name, each in errors.items()}
    found.best = min(means, key=lambda name: means[name])
    difference = mine[usable] - errors[found.best][usable]
    root = (lambda e: float(np.sqrt(e))) if data.site.kind == "rssi" else (lambda e: e / max(means["zero"], 1e-300))
    found.own_error, found.best_error = root(float(mine[usable].mean())), root(means[found.best])
    spread = 2 * standard_error(difference, unit[usable])
    found.allowed = max(BEHIND * found.best_error, root(means[found.best] + spread) - found.best_error)
    found.seconds = time.perf_counter() - started
    return found, objects


def _plain(data: Measurements, split) -> tuple[str, ...]:
    return fitting(data, split)


def _errors(scores: Scores) -> np.ndarray:
    """Squared error (n,) of each test row: of decibels where powers are measured."""
    value = scores.samples[FIGURE[scores.kind]]
    return value**2 if scores.kind == "rssi" else value


def _unit(world: World, data: Measurements, rows: np.ndarray) -> np.ndarray:
    """(n,) which rows were held out together."""
    if world.split == "runs" and data.run is not None:
        return data.run[rows]
    if world.split == "blocks":
        floor = data.moving[:, :2]
        square = np.floor(floor / (np.ptp(floor, axis=0).max() / 10))
        return np.unique(square[rows], axis=0, return_inverse=True)[1].reshape(-1)
    return np.arange(len(rows))


def standard_error(difference: np.ndarray, unit: np.ndarray) -> float:
    """Of the mean of differences (n,), those of a unit not independent; of rows, where there is one unit."""
    number = np.unique(unit, return_inverse=True)[1].reshape(-1)
    if number.max() == 0:
        number = np.arange(len(unit))
    sums = np.bincount(number, difference - difference.mean())
    count = len(sums)
    return float(np.sqrt((sums**2).sum() * count / max(count - 1, 1)) / len(difference))


def repeated(world: World, folder: Path) -> tuple[float, float, float]:
    """Means over fresh seeds of our error, the best plain one, and what is allowed."""
    found = [run(world, 100 + seed, folder / f"fresh{seed}")[0] for seed in range(FRESH)]
    return tuple(float(np.nanmean([getattr(o, name) for o in found])) for name in ("own_error", "best_error", "allowed"))


def loaded(world: World, folder: Path) -> Measurements:
    """The world's measurements as read."""
    return load_own(folder / "own.npz")
