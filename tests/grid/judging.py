"""One world trained with defaults beside every plain method that trains on it, and judged."""

import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from campaigns import compose
from worlds import World, arrays

from gsparc.commands.train import TrainedRun, train
from gsparc.data.schema import Measurements
from gsparc.data.target import Kind
from gsparc.evaluation.scores import score_methods
from gsparc.runs.baselines import baselines_for, fit_baseline

BEHIND = 1.05  # times the best plain method's error that ours may have
FRESH = 5  # seeds that repeat a miss


@dataclass
class Outcome:
    """What a world came to.

    Attributes:
        world, seed: which.
        seconds: of everything [s].
        fit_s: of the fit [s].
        model: its terms, where its Gaussians come from, and their number.
        own, best, allowed: our error, that of the plain method `name`, and how much larger ours may
            be: minus PSNR in dB of spectra, NMSE of channels, rmse in dB of powers.
        errors: of every plain method.
        plain: whether the default came to no more than a plain process.
        refused: what it said instead; then nothing else is known.
    """

    world: str
    seed: int
    seconds: float = 0.0
    fit_s: float = 0.0
    model: str = ""
    name: str = ""
    own: float = math.nan
    best: float = math.nan
    allowed: float = math.nan
    errors: dict[str, float] = field(default_factory=dict)
    plain: bool = False
    refused: str = ""

    @property
    def behind(self) -> bool:
        """Whether the default lost."""
        return self.own - self.best > self.allowed

    def grossly_behind(self, times: float) -> bool:
        """Whether its error is `times` what is allowed:
        more than few seconds of training explain.
        """
        most = self.best + self.allowed
        return self.own > (most * times if self.best > 0 else most + 10 * math.log10(times))

    def line(self) -> str:
        """For a file of results."""
        return json.dumps(asdict(self))


def run(
    world: World, seed: int, folder: Path, more: tuple[str, ...] = ()
) -> tuple[Outcome, TrainedRun | None]:
    """Train and judge; files go to `folder`, `more` overrides."""
    folder.mkdir(parents=True, exist_ok=True)
    file, started = folder / "own.npz", time.perf_counter()
    np.savez(file, **arrays(world, seed))
    found = Outcome(world.name, seed)
    said = [
        "dataset=own",
        f"dataset.file='{file}'",
        "model=gsparc",
        f"split={world.split}",
        "logger=none",
    ]
    try:
        facts, objects = train(compose(*said, "baselines=[zero]", *more), folder / "run")
    except ValueError as error:
        found.refused, found.seconds = str(error), time.perf_counter() - started
        return found, None
    data, split, gaussians = objects.data, objects.split, int(facts["model/num_gaussians"])
    found.fit_s = float(facts["time/train_s"])
    found.plain = gaussians == 0 and facts["model/effects"] == "residual"
    found.model = f"{facts['model/effects']} from {facts['model/init']}, {gaussians} Gaussians"
    kind = data.site.kind
    own = _losses(kind, score_methods(objects.methods, data, split).samples)
    plain = {
        name: _losses(kind, fit_baseline(name, data, split).scores.samples)
        for name in baselines_for(data, split)
    }
    told = np.isfinite(own)
    means = {name: float(each[told].mean()) for name, each in plain.items()}
    found.errors = {name: _figure(kind, mean) for name, mean in means.items()}
    found.name = min(means, key=lambda name: means[name])
    difference = own[told] - plain[found.name][told]
    spread = standard_error(difference, _unit(world, data, split.folds[0].test)[told])
    found.own, found.best = _figure(kind, float(own[told].mean())), _figure(kind, means[found.name])
    found.allowed = max(
        _least(world, found.best), _figure(kind, means[found.name] + 2 * spread) - found.best
    )
    found.seconds = time.perf_counter() - started
    return found, objects


def repeated(world: World, folder: Path, more: tuple[str, ...] = ()) -> Outcome:
    """The mean over fresh seeds, beside the plain method that is best in the mean."""
    every = [run(world, 100 + seed, folder / f"fresh{seed}", more)[0] for seed in range(FRESH)]
    errors = {name: float(np.mean([o.errors[name] for o in every])) for name in every[0].errors}
    best = min(errors, key=lambda name: errors[name])
    difference = np.array([o.own - o.errors[best] for o in every])
    spread = 2 * float(difference.std(ddof=1)) / math.sqrt(FRESH)
    return replace(
        every[0],
        seed=-1,
        seconds=sum(o.seconds for o in every),
        own=float(np.mean([o.own for o in every])),
        name=best,
        best=errors[best],
        errors=errors,
        allowed=max(spread, _least(world, errors[best])),
    )


def _least(world: World, best: float) -> float:
    spectra = world.kind in ("array", "moving_array", "image")
    return 10 * math.log10(BEHIND) if spectra else (BEHIND - 1) * best


def _losses(kind: Kind, samples: dict[str, np.ndarray]) -> np.ndarray:
    """(n,) of each test row, less is better: what the deciding figure is the mean of."""
    if kind == "csi":
        return samples["error_power"] / np.nanmean(samples["target_power"])
    if kind == "rssi":
        return samples["error_db"] ** 2
    return np.where(
        samples["target_power"] > 0, -samples["psnr_db"], np.nan
    )  # nothing equals silence but zero


def _figure(kind: Kind, loss: float) -> float:
    return math.sqrt(loss) if kind == "rssi" else loss


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
    """Of the mean of differences (n,), those of a unit not independent; of rows,
    where there is one unit.
    """
    number = np.unique(unit, return_inverse=True)[1].reshape(-1)
    if number.max() == 0:
        number = np.arange(len(unit))
    sums = np.bincount(number, difference - difference.mean())
    return float(np.sqrt((sums**2).sum() * len(sums) / max(len(sums) - 1, 1)) / len(difference))
