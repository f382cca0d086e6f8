"""One run: a method fitted on every fold of a split, tested beside baselines, drawn and written down."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsparc.data import heeded
from gsparc.data.checks.describe import in_short
from gsparc.data.datamodule import DataModule
from gsparc.data.files import is_address, platform_cache
from gsparc.data.instantiate import suggest
from gsparc.data.load import datamodule, split_for
from gsparc.data.schema import Kind, Measurements
from gsparc.data.splits import Split, write_split
from gsparc.data.walls import read_walls
from gsparc.evaluation.console import plain
from gsparc.evaluation.evaluate import Evaluation, evaluate
from gsparc.evaluation.experiment import options
from gsparc.evaluation.experiment.fit import context_of, fit_and_score
from gsparc.evaluation.found_plan import draw_found
from gsparc.evaluation.metric_formats import DECIDING
from gsparc.evaluation.metrics import figure_names
from gsparc.evaluation.open_runs import aligned
from gsparc.evaluation.pictures import draw_predictions
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import new_run_id, provenance, result_rows, write_samples, write_summary
from gsparc.models import checkpoint, parts
from gsparc.models.method import Method, TrainsByGradient
from gsparc.models.registry import build, known, method_node
from gsparc.training import curve, tracking
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import TimeBudget

log = logging.getLogger(__name__)
log_of_models = logging.getLogger("gsparc.models")  # of which the console shows warnings alone

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


def run(config: DictConfig, run_dir: Path) -> tuple[dict[str, Any], Objects]:
    """Fit on every fold, test beside the baselines, and write it all down.

    Args:
        config: as composed from conf/train.yaml.
        run_dir: where checkpoints, curves, pictures and `summary.json` go.

    Returns:
        The facts of `summary.json`, and the objects they were computed from.

    Raises:
        ValueError: bad data, settings or checkpoint; one line each.
    """
    watch = TimeBudget(clock=config.budget_clock)
    reads = options.noting(config)
    with heeded.recording(reads):
        module = _data(config)
        data = module.measurements
        split = split_for(plain(config.split), data)
    objective_of(config, data.site.kind)  # refused now, not after the training
    walls = config.get("known_walls") or OmegaConf.select(config, "init.file")
    known_walls = None if walls is None else read_walls(walls)
    split.check()  # none without rows to learn from or to test on
    for topic, sentence in in_short(data, split):
        log.info("%-10s%s", topic, sentence)
    run_id = new_run_id()
    write_split(run_dir / "split.json", split, len(data), data.site.sha256, run_id)
    count = len(split.folds)
    folders = [run_dir] if count == 1 else [run_dir / f"fold{number}" for number in range(count)]
    files = tuple(folder / "model.ckpt" for folder in folders)
    resumes = [_resume(config, number, count) for number in range(count)]
    _check_model(config, any(resumes))
    yaml = OmegaConf.to_yaml(config, resolve=True)

    def keep(number: int, method: Method, report: FitReport) -> None:
        for note in report.notes:
            log_of_models.info("%s", note)
        if not curve.read(folders[number]):  # a method that trains in one piece
            context(number).curve(report.seconds, method.name)
        marks = parts.marks(report, data, split.folds[number], context(number))
        extra = {**marks, "fold": number, "split_sha256": split.sha256, "run_id": run_id}
        checkpoint.save(files[number], method, yaml, extra)

    with tracking.opened(config) as loggers:
        read_s = watch.spent  # counts: the seconds that are given begin with the first read

        def context(number: int) -> FitContext:
            own = loggers if count == 1 else [tracking.Part(one, f"fold{number}") for one in loggers]
            there = {"run_dir": folders[number], "resume": resumes[number]}
            base = context_of(config, loggers=own, datamodule=module, **there)
            if number or base.budget_s is None:
                return base
            return replace(base, budget_s=max(base.budget_s - read_s, LEAST_SHARE * base.budget_s))

        try:
            make = partial(build, config.model)
            with heeded.recording(reads):
                fitted = fit_and_score(make, data, split, context, eval_on=None, keep=keep)
                fitted.methods[0].predict(data.batch(rows_of(split.folds[0], config.eval_on)[:1]))
        except KeyboardInterrupt as stopped:
            if count == 1:
                raise
            cause = str(stopped).partition("; ")[0] or "interrupted"
            raise KeyboardInterrupt(f"{cause}; go on with ckpt_path={run_dir}") from None
        methods = fitted.methods
        unused = options.unheeded(reads, methods[0], data)
        evaluation = evaluate(
            methods, fitted.train_s, data, split,
            eval_on=config.eval_on, baselines=config.baselines, cache=platform_cache(),
            shared=_as_baseline(config, methods[0]),
        )  # fmt: skip
        facts: dict[str, Any] = {
            **evaluation.facts, **provenance(), "run_id": run_id,
            "seed": int(config.seed), "model/limited_by_clock": fitted.limited_by,
            "options/unused": unused,
        }  # fmt: skip
        if fitted.cost.stages:
            facts["time/cost"] = fitted.cost.described(fitted.limited_by)
            facts["time/unused_s"] = fitted.cost.unused_s
        # Under other names, as `time/train_s` would cut off its curve; of the baselines a table.
        own = {
            f"final/{name}": value
            for name, value in facts.items()
            if isinstance(value, (int, float)) and not name.startswith(("baseline/", "paired/"))
        }
        tracking.final(loggers, own)
        title = f"{data.site.name}: test rows of {methods[0].label}"
        draw_predictions(methods[0], data, split.folds[0], title, run_dir / "test.png")
        tracking.picture(loggers, "test rows", run_dir / "test.png")
        label = str(facts["model/label"])
        tracking.table(loggers, "results", *result_rows(facts, label, config.eval_on))
        objects = methods[0].objects()
        if len(objects):
            draw_found(data, objects, run_dir / "found.png", known_walls)
            tracking.picture(loggers, "found", run_dir / "found.png")
    samples = {**evaluation.columns, "run_id": [run_id] * len(evaluation.columns["row"])}
    write_samples(run_dir / "per_sample.csv", samples)
    write_summary(run_dir / "summary.json", facts)
    return facts, Objects(methods, files, data, split, evaluation)


def _data(config: DictConfig) -> DataModule:
    """The data, in the coordinates and units of the model that training starts from, if there is one."""
    path, start = config.ckpt_path, config.get("init_from")
    if path is not None and not Path(path).exists():  # before anything is read or simulated
        raise ValueError(f"ckpt_path={path}: no such file")
    module = datamodule(config.dataset)
    module.measurements  # noqa: B018 (read now, so that errors show the path that was typed)
    for key in ("root", "file"):  # absolute, so that a checkpoint finds its data from any folder
        given = None if OmegaConf.is_missing(config.dataset, key) else config.dataset.get(key)
        if given and not is_address(given):
            config.dataset[key] = str(Path(config.dataset[key]).resolve())
    if start is not None:
        try:
            module.measurements = aligned(module.measurements, checkpoint.read(start).site)
        except ValueError as error:
            raise ValueError(f"init_from={start}: {error}") from None
    return module


def _as_baseline(config: DictConfig, method: Method) -> str | None:
    """Its name where a baseline of that name would be fitted in the same way."""
    plainly = config.eval_on != "val" and config.get("stations", "auto") == "auto" and not method.takes_budget
    kind = known().get(method.name)
    return method.name if plainly and kind and plain(config.model) == method_node(kind) else None


def _check_model(config: DictConfig, resumed: bool) -> None:
    """Say what the model guesses; refuse weights to start from, or a resume, where they mean nothing."""
    method = build(config.model)
    if config.get("init_from") is not None and not isinstance(method, TrainsByGradient):
        raise ValueError(f"init_from: {method.name} does not train by gradient; start without it")
    if resumed and not method.resumable and not Path(config.ckpt_path).is_dir():  # with parts that finished
        raise ValueError(f"ckpt_path: {method.name} trains in one piece; start again without ckpt_path")
    for guess in method.guesses:
        log_of_models.info("guess: %s", guess)
    guessed = f", {len(method.guesses)} settings of it guessed" if method.guesses else ""
    within = "" if config.budget_s is None else f", within {config.budget_s:g} s"
    log.info("%-10s%s%s%s", "fitting", method.name, within, guessed)


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


def objective_of(config: DictConfig, kind: Kind) -> str:
    """The figure that a search improves, of rows `eval_on`; `objective: null` takes the deciding one.

    Raises:
        ValueError: there is no such figure.
    """
    figures = [DECIDING[kind], *figure_names(kind), "skill"]
    known = {f"{config.eval_on}/{figure}": figure for figure in figures}
    objective = config.get("objective")
    if objective is not None and objective not in known:
        raise ValueError(f"objective={objective}: no such figure{suggest(str(objective), known)}")
    return DECIDING[kind] if objective is None else known[objective]
