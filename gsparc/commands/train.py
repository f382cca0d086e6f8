"""Compose, fit, test, write: what `train.py` and `gsparc train` do."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gsparc.commands.shared import cli
from gsparc.commands.shared.continued import once
from gsparc.commands.shared.output import run_directory, show
from gsparc.commands.shared.run_lock import locked
from gsparc.commands.shared.settings import RunSettings
from gsparc.data.files import set_aside
from gsparc.evaluation.experiment.run import Objects, objective_of, run
from gsparc.evaluation.metric_formats import score_of
from gsparc.evaluation.summary import remarks, results_table

log = logging.getLogger(__name__)

# What a run leaves; of another one, all of it would be read beside this one's.
LEFT = (
    *("summary.json", "split.json", "per_sample.csv", "render_ms.csv", "test.png", "found.png"),
    *(f"{fold}{name}" for fold in ("", "fold*/") for name in ("model.ckpt", "learning_curve.csv")),
)


def train(config: DictConfig, run_dir: Path) -> tuple[dict[str, Any], Objects]:
    """Fit a method on every fold of a split and test it, as `run` does; the folder is locked meanwhile.

    What an earlier run left there is set aside first, but for what this one goes on, or starts, from.

    Raises:
        ValueError: as `run`; or another run writes there.
    """
    with locked(run_dir):
        taken = [Path(config[name]).resolve() for name in ("ckpt_path", "init_from") if config.get(name)]
        goes_on = any(run_dir.resolve() in (path, *path.parents) for path in taken)
        if set_aside(run_dir, *LEFT[: 1 if goes_on else None]):
            log.info("%s: results of an earlier run are kept as NAME.earlier", run_dir)
        RunSettings.of(config)
        return run(config, run_dir)


def task(config: DictConfig) -> float:
    """Train as configured and show the table; what was interrupted goes on, see `once`.

    Returns:
        The objective, larger is better: ratios of powers as -10 log10, errors with their sign turned; NaN
            where the data do not tell it and no search asks.
    """
    job = HydraConfig.get().mode == RunMode.MULTIRUN
    if config.ckpt_path is not None:
        words = HydraConfig.get().overrides.task
        log.info("with the settings of the run that it goes on from: %s", " ".join(words))
    return once(run_directory(), config, _train_and_show, again=not job)


def _train_and_show(config: DictConfig) -> float:
    run_dir = run_directory()
    facts, objects = train(config, run_dir)
    figure = objective_of(config, objects.data.site.scored)
    title = f"{objects.data.site.name}, split {objects.split.name}, {config.eval_on}, seed {config.seed}"
    results = results_table(facts, facts["model/label"], title, config.eval_on)
    show(run_dir, results, lines=remarks(facts, config.eval_on))
    value = facts[f"{config.eval_on}/{figure}"]
    if value is not None:
        return score_of(figure, value)
    hydra = HydraConfig.get()
    if hydra.mode == RunMode.MULTIRUN and hydra.runtime.choices["hydra/sweeper"] != "basic":
        raise ValueError(f"objective={config.eval_on}/{figure}: these data and baselines do not tell it")
    return math.nan  # only a search asks for it


def main() -> None:
    """Entry point."""
    cli.run(task, "train")
