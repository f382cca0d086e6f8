"""Compose, fit, test, write: what `train.py` and `gsparc train` do."""

from __future__ import annotations

import logging
import math
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.commands import cli
from gsparc.commands.continued import once
from gsparc.commands.output import run_directory, show
from gsparc.commands.run_lock import held
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.datamodule import DataModule
from gsparc.data.files import platform_cache
from gsparc.data.instantiate import suggest
from gsparc.data.load import datamodule, split_for
from gsparc.data.schema import Kind, Measurements
from gsparc.data.splits import Split, write_split
from gsparc.data.walls import read_walls
from gsparc.evaluation.evaluate import Evaluation, evaluate
from gsparc.evaluation.experiment.fit import callbacks_of, context_of, fit_and_score
from gsparc.evaluation.found_plan import draw_found
from gsparc.evaluation.metric_formats import DECIDING, score_of
from gsparc.evaluation.metrics import figure_names
from gsparc.evaluation.open_runs import aligned
from gsparc.evaluation.pictures import draw_predictions
from gsparc.evaluation.summary import (
    provenance,
    remarks,
    result_rows,
    results_table,
    write_samples,
    write_summary,
)
from gsparc.models import checkpoint, parts
from gsparc.models.method import Method, TrainsByGradient
from gsparc.models.registry import build
from gsparc.training import tracking
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import TimeBudget

log = logging.getLogger(__name__)

LEAST_SHARE = 0.1  # of the seconds, for the fit, however long reading took


@dataclass(frozen=True)
class Objects:
    """What a run made, for callers from Python.

    Attributes:
        methods: one fitted method per fold.
        checkpoints: their files.
        data, split: what they learned from.
        evaluation: figures and per-sample columns.
    """

    methods: tuple[Method, ...]
    checkpoints: tuple[Path, ...]
    data: Measurements
    split: Split
    evaluation: Evaluation


def train(config: DictConfig, run_dir: Path) -> tuple[dict[str, Any], Objects]:
    """Fit a method on every fold of a split, test it beside the baselines, and write it all down.

    Args:
        config: as composed from conf/train.yaml.
        run_dir: where checkpoints, curves, pictures and `summary.json` go.

    Returns:
        The facts of `summary.json`, and the objects they were computed from.

    Raises:
        ValueError: bad data, settings or checkpoint, or another run writes there; one line each.
    """
    with held(run_dir):
        return _train(config, run_dir)


def _train(config: DictConfig, run_dir: Path) -> tuple[dict[str, Any], Objects]:
    RunSettings.of(config)
    watch = TimeBudget(clock=config.budget_clock)
    module = _data(config)
    data = module.measurements
    objective_of(config, data.site.kind)  # refused now, not after the training
    walls = config.get("known_walls") or OmegaConf.select(config, "init.file")
    known = None if walls is None else read_walls(walls)
    split = split_for(plain(config.split), data)
    split.check()  # none without rows to learn from or to test on
    write_split(run_dir / "split.json", split, len(data), data.site.sha256)
    count = len(split.folds)
    folders = [run_dir] if count == 1 else [run_dir / f"fold{number}" for number in range(count)]
    files = tuple(folder / "model.ckpt" for folder in folders)
    resumes = [_resume(config, number, count) for number in range(count)]
    _check_model(config, any(resumes))
    yaml = OmegaConf.to_yaml(config, resolve=True)

    def keep(number: int, method: Method, report: FitReport) -> None:
        _log_fit(method, report, config.budget_s)
        marks = parts.marks(report, data, split.folds[number], context(number))
        extra = {**marks, "fold": number, "split_sha256": split.sha256}
        checkpoint.save(files[number], method, yaml, extra)

    model = partial(build, config.model)
    trainer = instantiate(config.trainer, _partial_=True)
    callbacks = partial(callbacks_of, config.get("callbacks"))
    with tracking.opened(config.logger) as loggers:
        given = {"trainer": trainer, "callbacks": callbacks, "loggers": loggers, "datamodule": module}

        read_s = watch.spent  # counts: the seconds that are given begin with the first read

        def context(number: int) -> FitContext:
            found = context_of(config, run_dir=folders[number], resume=resumes[number], **given)
            if number or found.budget_s is None:
                return found
            return replace(found, budget_s=max(found.budget_s - read_s, LEAST_SHARE * found.budget_s))

        try:
            fitted = fit_and_score(model, data, split, context, eval_on=None, keep=keep)
        except KeyboardInterrupt as stopped:
            if count == 1:
                raise
            said = str(stopped).partition("; ")[0] or "interrupted"
            raise KeyboardInterrupt(f"{said}; go on with ckpt_path={run_dir}") from None
        methods = fitted.methods
        found = evaluate(
            methods, fitted.train_s, data, split,
            eval_on=config.eval_on, baselines=config.baselines, cache=platform_cache(),
        )  # fmt: skip
        run: dict[str, Any] = {"seed": int(config.seed), "model/limited_by_clock": fitted.limited_by}
        if fitted.cost.stages:
            run["time/cost"] = fitted.cost.described(fitted.limited_by)
            run["time/unused_s"] = fitted.cost.unused_s
        facts = {**found.facts, **provenance(), **run}
        # Under other names, as `time/train_s` would cut off its curve; of the baselines a table.
        numbers = {k: v for k, v in facts.items() if isinstance(v, (int, float))}
        own = {k: v for k, v in numbers.items() if not k.startswith(("baseline/", "paired/"))}
        for logger in loggers:
            logger.log_metrics({f"final/{k}": v for k, v in own.items()})
        title = f"{data.site.name}: test rows of {methods[0].label}"
        draw_predictions(methods[0], data, split.folds[0], title, run_dir / "test.png")
        tracking.picture(loggers, "test rows", run_dir / "test.png", 0)
        label = str(facts["model/label"])
        tracking.table(loggers, "results", *result_rows(facts, label, config.eval_on))
        objects = methods[0].objects()
        if len(objects):
            draw_found(data, objects, run_dir / "found.png", known)
            tracking.picture(loggers, "found", run_dir / "found.png", 0)
    write_samples(run_dir / "per_sample.csv", found.columns)
    write_summary(run_dir / "summary.json", facts)
    return facts, Objects(methods, files, data, split, found)


def _data(config: DictConfig) -> DataModule:
    """The data, in the coordinates and units of the model that training starts from, if there is one."""
    path, start = config.ckpt_path, config.get("init_from")
    if path is not None and not Path(path).exists():  # before anything is read or simulated
        raise ValueError(f"ckpt_path={path}: no such file")
    module = datamodule(config.dataset)
    module.measurements  # noqa: B018 (read now, so that errors show the path that was typed)
    for key in ("root", "file"):  # absolute, so that a checkpoint finds its data from any folder
        if not OmegaConf.is_missing(config.dataset, key) and config.dataset.get(key):
            config.dataset[key] = str(Path(config.dataset[key]).resolve())
    if start is not None:
        try:
            module.measurements = aligned(module.measurements, checkpoint.read(start).site)
        except ValueError as error:
            raise ValueError(f"init_from={start}: {error}") from None
    return module


def _check_model(config: DictConfig, resumed: bool) -> None:
    """Say what the model guesses; refuse weights to start from, or a resume, where they mean nothing."""
    method = build(config.model)
    if config.get("init_from") is not None and not isinstance(method, TrainsByGradient):
        raise ValueError(f"init_from: {method.name} does not train by gradient; start without it")
    if resumed and not method.resumable and not Path(config.ckpt_path).is_dir():  # with parts that finished
        raise ValueError(f"ckpt_path: {method.name} trains in one piece; start again without ckpt_path")
    for guess in method.guesses:
        log.info("guess: %s", guess)


def _resume(config: DictConfig, number: int, folds: int) -> Path | None:
    """What to go on from, a file or a folder; each of several folds has its own in the run's."""
    if config.ckpt_path is None:
        return None
    path = Path(config.ckpt_path)
    if folds == 1:
        return path
    own = parts.folder_of(path, parts.FOLDS) / f"fold{number}"
    if path.is_file() and own not in path.parents and not own.parent.glob("fold*"):
        raise ValueError(
            f"ckpt_path={path}: split={config.split.name} has {folds} folds, give the run's folder"
        )
    return own if own.is_dir() else None


def _log_fit(method: Method, report: FitReport, budget_s: float | None) -> None:
    """What the fit found, and whether a budget or options of the Trainer were asked for and not used."""
    if budget_s is not None and not method.takes_budget:
        log.warning("budget_s=%g is not used: the seconds of %s cannot be chosen", budget_s, method.name)
    if not (isinstance(method, TrainsByGradient) and method.trainer_options()):
        said = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
        unused = [o for o in said if re.match(r"[+~]*(trainer[.=]|init_from=)", o)]
        options = ", ".join(unused) or "accelerator, devices, precision, max_steps, ..."
        level = logging.WARNING if unused else logging.DEBUG
        text = "%s does not train by gradient: trainer options (%s) are not used"
        log.log(level, text, method.name, options)
    for note in report.notes:
        log.info("%s", note)


def objective_of(config: DictConfig, kind: Kind) -> str:
    """The figure that a search improves, of rows `eval_on`; `objective: null` takes the deciding one.

    Raises:
        ValueError: there is no such figure.
    """
    figures = [DECIDING[kind], *figure_names(kind), "skill"]
    known = {f"{config.eval_on}/{figure}": figure for figure in figures}
    asked = config.get("objective")
    if asked is not None and asked not in known:
        raise ValueError(f"objective={asked}: no such figure{suggest(str(asked), known)}")
    return known[asked] if asked is not None else DECIDING[kind]


def task(config: DictConfig) -> float:
    """Train as configured and show the table; what was interrupted goes on, see `once`.

    Returns:
        The objective, larger is better: ratios of powers as -10 log10, errors with their sign turned; NaN
            where the data do not tell it and no search asks.
    """
    job = HydraConfig.get().mode == RunMode.MULTIRUN
    return once(run_directory(), config, _train_and_show, again=not job)


def _train_and_show(config: DictConfig) -> float:
    run_dir = run_directory()
    facts, objects = train(config, run_dir)
    figure = objective_of(config, objects.data.site.kind)
    title = f"{objects.data.site.name}, split {objects.split.name}, {config.eval_on}, seed {config.seed}"
    shown = results_table(facts, facts["model/label"], title, config.eval_on)
    show(run_dir, shown, lines=remarks(facts, config.eval_on))
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
