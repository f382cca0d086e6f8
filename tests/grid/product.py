"""What else the product must do with a trained world: every part answers, and alike."""

from pathlib import Path

import numpy as np
import torch
from campaigns import compose
from doors import knock
from rich.console import Console
from worlds import World

import gsparc
from gsparc.commands.check import check
from gsparc.commands.evaluate import evaluate_files
from gsparc.commands.listing import COMMANDS
from gsparc.commands.train import TrainedRun, train
from gsparc.data.schema import Measurements
from gsparc.evaluation.metric_formats import DECIDING
from gsparc.models import loading

FAR_M = 1e3  # from all that was measured
SURE_FAR = 0.3  # confidence there, at most


def checked(world: World, folder: Path, objects: TrainedRun) -> None:
    """`gsparc check` finds the file good."""
    assert check(str(folder / "own.npz"), Console(quiet=True)), "check"


def reloaded(world: World, folder: Path, objects: TrainedRun) -> None:
    """The checkpoint answers as the model that was trained."""
    method, _ = loading.load(folder / "run" / "model.ckpt")
    batch = objects.data.batch(objects.split.folds[0].test[:16])
    before, after = (one.predict(batch) for one in (objects.methods[0], method))
    scale = float(before.mean.abs().max()) or 1.0
    assert torch.allclose(after.mean, before.mean, atol=1e-4 * scale), "reload: other predictions"
    if before.confidence is not None:
        assert torch.allclose(after.confidence, before.confidence, atol=1e-3), (
            "reload: other confidence"
        )


def predicted(world: World, folder: Path, objects: TrainedRun) -> None:
    """Predictions at places in the world's coordinates are finite, and unsure far away."""
    data, rows = objects.data, objects.split.folds[0].train[:8]
    predictor = gsparc.load(folder / "run" / "model.ckpt")
    if data.site.stations is not None and len(data.site.stations) > 1:
        predictor = predictor.select_station(data.site.stations.name[0])
    near, far = _places(data, rows, 0.0), _places(data, rows, FAR_M)
    for places in (near, far):
        found = np.asarray(getattr(predictor, data.site.kind)(**places))
        assert np.isfinite(found).all(), "predict: not finite"
    sure = [float(np.median(np.asarray(predictor.confidence(**places)))) for places in (near, far)]
    assert sure[1] <= max(SURE_FAR, 0.5 * sure[0]) and sure[1] <= sure[0], (
        f"confidence near, far: {sure}"
    )


def evaluated(world: World, folder: Path, objects: TrainedRun) -> None:
    """`gsparc evaluate` finds the figure that training did."""
    figure = f"test/{DECIDING[objects.data.site.kind]}"
    again = evaluate_files([folder / "run" / "model.ckpt"], {"file": str(folder / "own.npz")})[
        0
    ].facts
    before = objects.evaluation.facts[figure]
    assert abs(again[figure] - before) <= 1e-3 * abs(before) + 1e-6, (
        f"evaluate: {again[figure]}, not {before}"
    )


def drawn(world: World, folder: Path, objects: TrainedRun) -> None:
    """A map of powers without promise, a page of the rest."""
    ckpt = f"ckpt='{folder / 'run' / 'model.ckpt'}'"
    if world.kind == "power" and world.moving != "both":
        said, entry = ["promised=false", "step_m=0.5", "pictures=false"], COMMANDS["map"].run
    else:
        said, entry = [f"save='{folder / 'view.html'}'", "step_m=0.5"], COMMANDS["view"].run
    answer = knock(entry, "gsparc", [ckpt, *said, f"hydra.run.dir='{folder / 'drawn'}'"])
    assert answer.status == 0, answer.err[-1:]


def resumed(world: World, folder: Path, objects: TrainedRun) -> None:
    """Trained again from the run's last state, where it has one,
    it ends with about the same figure.
    """
    last = folder / "run" / "last.ckpt"
    if not last.exists():
        return
    said = [
        "dataset=own",
        f"dataset.file='{folder / 'own.npz'}'",
        "model=gsparc",
        f"split={world.split}",
    ]
    more = [f"ckpt_path='{last}'", "baselines=[zero]", "logger=none"]
    facts, _ = train(compose(*said, *more), folder / "again")
    figure = f"test/{DECIDING[objects.data.site.kind]}"
    before = objects.evaluation.facts[figure]
    # Seconds end searches, so that a resumed one may come to more; it may not come to less by much.
    assert abs(facts[figure] - before) <= 0.3 * abs(before) + 1e-6, (
        f"resume: {facts[figure]}, not {before}"
    )


PARTS = (checked, reloaded, predicted, evaluated, drawn, resumed)


def _places(data: Measurements, rows: np.ndarray, away: float) -> dict[str, np.ndarray]:
    """What moves, in world coordinates, `away` [m] from where rows (n,) were measured."""
    shift = data.site.origin + np.array([away, -away, 0.0])
    ends = {"tx": data.tx[rows] + shift, "rx": data.rx_position[rows] + shift}
    moving = ("tx", "rx") if data.site.static_end is None else (data.site.moving_end,)
    return {end: ends[end] for end in moving}
