"""What a training begins with: checked settings, a method, data that are read, and their folds; one
of a multirun that is done is not done again.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsparc.base.instantiate import from_settings
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.data.walls import read_walls
from gsparc.datasets.datamodule import DataModule
from gsparc.datasets.describe import summarise
from gsparc.datasets.load import datamodule, split_for
from gsparc.evaluation.metric_formats import main_figure, score_of
from gsparc.models import checkpoint
from gsparc.models.method import MethodFactory
from gsparc.models.registry import build, fill_defaults
from gsparc.runs.align_site import align_to_site
from gsparc.runs.experiment.disturb import Disturbance
from gsparc.runs.ledger import FitInputs, measurements_hash, read_finished, run_once
from gsparc.runs.output import in_multirun, run_directory
from gsparc.runs.run_lock import locked
from gsparc.runs.settings import RunSettings, to_dict
from gsparc.tables.sheet import say_quantity
from gsparc.training import tracking
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)
log_of_models = logging.getLogger("gsparc.models")  # of which the console shows warnings alone


@dataclass(frozen=True)
class RunInputs:
    """What a run begins with, before anything is fitted.

    Attributes:
        method: unfitted, or what chooses it.
        module, split: the data, read, and their folds.
        walls: known ones, drawn beside what is found.
        errors: that are added to what is learned from, or asked.
    """

    method: MethodFactory
    module: DataModule
    split: Split
    walls: Any
    errors: Disturbance

    @property
    def data(self) -> Measurements:
        """The measurements."""
        return self.module.measurements


def read_inputs(config: DictConfig, known: Measurements | None = None) -> RunInputs:
    """Check the settings and read the data; nothing is written.

    Args:
        config: as composed from conf/train.yaml.
        known: the measurements, where they were read before.

    Raises:
        ValueError: bad data, walls or settings, or a split without rows to learn from or to test
            on; one line each.
    """
    # Once: each fold, and each station, fits a copy of it
    method = build(fill_defaults(config.model))
    RunSettings.from_config(config)
    errors = from_settings(Disturbance, to_dict(config.disturb), "disturb")
    tracking.refuse_missing_loggers(config)
    module = _data(config, known)
    split = split_for(to_dict(config.split), module.measurements)
    file = config.get("known_walls") or OmegaConf.select(config, "init.file")
    walls = None if file is None else read_walls(file)
    split.check()
    return RunInputs(method, module, split, walls, errors)


def _data(config: DictConfig, known: Measurements | None) -> DataModule:
    """The data, read or known, in coordinates and units of the model that training starts from,
    if any.
    """
    path, start = config.ckpt_path, config.get("init_from")
    if path is not None and not Path(path).exists():  # before anything is read or simulated
        raise ValueError(
            f"ckpt_path={path}: no such file; give an interrupted run's folder or last.ckpt"
        )
    module = datamodule(config.dataset)
    if known is not None:
        module.measurements = known
    module.measurements  # noqa: B018 (read now, so that errors show the path that was typed)
    # As they were answered: other files are read so, too
    for quantity, column in module.said.items():
        OmegaConf.update(
            config, f"dataset.columns.{say_quantity(quantity)}", column, force_add=True
        )
    if module.said:  # which holds what a file about columns says
        OmegaConf.update(config, "dataset.columns_file", None, force_add=True)
    for key in ("root", "file"):  # absolute, so that a checkpoint finds its data from any folder
        location = None if OmegaConf.is_missing(config.dataset, key) else config.dataset.get(key)
        if location:
            config.dataset[key] = str(Path(location).resolve())
    if start is not None:
        try:
            site = checkpoint.read(start).site
            same = site.sha256 == module.measurements.site.sha256
            module.measurements = align_to_site(module.measurements, site, whole=True)
        except ValueError as error:
            raise ValueError(f"init_from={start}: {error}") from None
        if same:
            learned = "its model learned from these data, perhaps from rows that validate here"
            log.warning("init_from=%s: %s: choices made on them are too sure", start, learned)
    return module


def describe_inputs(config: DictConfig, inputs: RunInputs) -> None:
    """Say what is learned from, and what is guessed."""
    method = inputs.method
    for topic, sentence in summarise(inputs.data, inputs.split):
        log.info("%-10s%s", topic, sentence)
    for guess in method.guesses:
        log_of_models.info("guess: %s", guess)
    name, guessed = method.name, ""
    if method.guesses:
        name += f" ({type(method).__name__})"
        guessed = f", {len(method.guesses)} settings of it guessed, see train.log"
    steps = config.trainer.max_steps
    effort = Effort().scale_by(config.effort)
    how = method.describe_fit(inputs.data, effort, None if steps == -1 else steps)
    log.info("%-10s%s", "fitting", f"{name}{f': {how}' if how else ''}{guessed}")


def train_once(
    config: DictConfig, train: Callable[[DictConfig, Path, RunInputs], object]
) -> dict[str, Any]:
    """Return the facts of a training; `train` does it, from what an interrupted try has left."""
    run_dir, job = run_directory(), in_multirun()

    def work(left: str | None) -> None:
        config.ckpt_path = config.ckpt_path or left
        train(config, run_dir, inputs)

    with locked(run_dir / ".job"):  # the run's own is its training's
        # Of a job that is done no data are read
        unread = FitInputs.from_config(config) if job else None
        facts = read_finished(run_dir, unread, config.reuse) if unread else None
        if facts is not None:
            log.info("%s: already done", run_dir)
            return facts
        inputs = read_inputs(config)
        data, split = measurements_hash(inputs.data), inputs.split.sha256
        state = FitInputs.from_config(config, data, split)
        state = replace(unread, data=data, split=split) if unread else state
        resumes = config.ckpt_path is not None
        if resumes:
            words = " ".join(HydraConfig.get().overrides.task)
            log.info("going on with the settings of the interrupted run: %s", words)
        return run_once(run_dir, state, work, reuse=config.reuse, again=not job, resumes=resumes)


def objective(config: DictConfig, facts: Mapping[str, Any]) -> float:
    """Return the deciding figure of a training, larger is better, which a search improves.

    Ratios of powers as -10 log10, errors with their sign turned; NaN where the data, or
    `split=none`, do not tell it and no search asks.
    """
    figure = main_figure(facts, config.eval_on)
    value = facts.get(f"{config.eval_on}/{figure}")  # absent where nothing was tested
    if value is not None:
        return score_of(figure, value)
    # A search cannot rank a job without its figure; a plain multirun can do without.
    if in_multirun() and HydraConfig.get().runtime.choices["hydra/sweeper"] != "basic":
        raise ValueError(
            f"{config.eval_on}/{figure}: these data do not tell what the search improves"
        )
    return math.nan
