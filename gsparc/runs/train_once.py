"""The run of a command, entered in the ledger:
a job of a multirun that is done is not done again.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from gsparc.evaluation.metric_formats import main_figure, score_of
from gsparc.runs.inputs import RunInputs, read_inputs
from gsparc.runs.ledger import FitInputs, measurements_hash, read_finished, run_once
from gsparc.runs.output import in_multirun, run_directory
from gsparc.runs.run_lock import locked

log = logging.getLogger(__name__)


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
