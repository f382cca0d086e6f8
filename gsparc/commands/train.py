"""Read data, split them, fit a method, test it, write: what `train.py` and `gsparc train` do."""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.shared import cli
from gsparc.commands.shared.output import in_multirun, run_directory, show_result
from gsparc.commands.shared.run_lock import locked
from gsparc.commands.shared.settings import RunSettings
from gsparc.data import heeded
from gsparc.data.checks.describe import summarise
from gsparc.data.datamodule import DataModule
from gsparc.data.errors import Caution
from gsparc.data.files import SUMMARY, set_aside
from gsparc.data.instantiate import config_node, import_target
from gsparc.data.load import datamodule, split_for
from gsparc.data.schema import Measurements
from gsparc.data.split_files import write_split
from gsparc.data.splits import Split
from gsparc.data.walls import read_walls
from gsparc.evaluation import summary
from gsparc.evaluation.align_site import align_to_site
from gsparc.evaluation.by_station import worst_stations
from gsparc.evaluation.console import to_dict
from gsparc.evaluation.evaluate import Evaluation, evaluate
from gsparc.evaluation.experiment import options
from gsparc.evaluation.experiment.folds import FoldFits, fit_context, fit_folds, fold_contexts
from gsparc.evaluation.found_plan import draw_found
from gsparc.evaluation.ledger import State, measurements_hash, read_finished, run_once
from gsparc.evaluation.metric_formats import main_figure, score_of
from gsparc.evaluation.pictures import draw_predictions
from gsparc.evaluation.scores import rows_to_score
from gsparc.evaluation.sector_levels import draw_sector_levels
from gsparc.models import checkpoint, fitting
from gsparc.models.method import Method, MethodFactory
from gsparc.models.registry import all_methods, build, fill_defaults
from gsparc.training import tracking
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)
log_of_models = logging.getLogger("gsparc.models")  # of which the console shows warnings alone

# What a run leaves; of another one, all of it would be read beside this one's.
LEFT = (
    *("summary.json", "split.json", "per_sample.csv", "by_station.csv", "render_ms.csv"),
    *("test.png", "found.png"),
    *(f"{fold}{name}" for fold in ("", "fold*/") for name in (checkpoint.MODEL, "learning_curve.csv")),
)


@dataclass(frozen=True)
class TrainedRun:
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


@dataclass(frozen=True)
class RunInputs:
    """What a run begins with, before anything is fitted.

    Attributes:
        method: unfitted, or what chooses it.
        module, split: the data, read, and their folds.
        reads: which of the given options were heeded so far.
    """

    method: MethodFactory
    module: DataModule
    split: Split
    reads: heeded.Reads


def read_inputs(config: DictConfig, known: Measurements | None = None) -> RunInputs:
    """Check the settings and read the data; nothing is written.

    Args:
        config: as composed from conf/train.yaml.
        known: the measurements, where they were read before.

    Raises:
        ValueError: bad data or settings, one line each.
    """
    method = build(fill_defaults(config.model))  # once: each fold, and each station, fits a copy of it
    RunSettings.from_config(config)
    tracking.refuse_missing_loggers(config)
    reads = options.options_to_note(config, method)
    with heeded.record_reads(reads):
        module = _data(config, known)
        return RunInputs(method, module, split_for(to_dict(config.split), module.measurements), reads)


def train(
    config: DictConfig, run_dir: Path, begun: RunInputs | None = None, *, in_full: bool = True
) -> tuple[dict[str, Any], TrainedRun]:
    """Fit a method on every fold of a split, test it beside baselines, and write it all down.

    The folder is locked meanwhile. What an earlier run left there is set aside first, but for what this one
    goes on, or starts, from.

    Args:
        config: as composed from conf/train.yaml.
        run_dir: where checkpoints, curves, pictures and `summary.json` go.
        begun: what it begins with, where that was read before.
        in_full: whether it says what it learns from, times queries and draws pictures, too.

    Returns:
        The facts of `summary.json`, and the objects they were computed from.

    Raises:
        ValueError: bad data, settings or checkpoint, one line each; or another run writes there.
    """
    with locked(run_dir):
        _set_earlier_aside(config, run_dir)
        begun = begun or read_inputs(config)
        method, reads, split, data = begun.method, begun.reads, begun.split, begun.module.measurements
        run_id = summary.new_run_id()
        resumes = _resumes(config, len(split.folds))
        _check(config, method, data, split, resumes)
        if in_full:
            _say(config, method, data, split)
        write_split(run_dir / "split.json", split, len(data), data.site.sha256, run_id)

        with tracking.open_loggers(config) as loggers:
            whole = fit_context(config, run_dir=run_dir, loggers=loggers, datamodule=begun.module)
            contexts = _of_folds(whole, split, resumes)
            with heeded.record_reads(reads), _advising(contexts):
                # `Method.fit` of every fold; what takes gradient steps (models/splat/method.py) makes the
                # Trainer of `config.trainer` there and calls `trainer.fit(module, datamodule)`.
                keep = partial(_keep, data, split, contexts, run_id)
                fits = fit_folds(method, data, split, contexts, keep=keep)
                # Some options are read by answers alone: one query, before unused options are listed.
                asked = "train" if split.name == "none" else config.eval_on
                fits.methods[0].predict(data.batch(rows_to_score(split.folds[0], asked)[:1]))

            unused = options.warn_of_unheeded(reads, fits.methods[0], data)
            evaluation = evaluate(
                fits.methods, fits.train_s, data, split, eval_on=config.eval_on, baselines=config.baselines,
                shared=_as_baseline(config, method), timed=in_full,
            )  # fmt: skip

            facts = {**evaluation.facts, **summary.provenance(), **_of_fits(fits)}
            facts |= {"run_id": run_id, "seed": int(config.seed), "options/unused": unused}
            files = tuple(context.run_dir / checkpoint.MODEL for context in contexts)
            objects = TrainedRun(fits.methods, files, data, split, evaluation)
            _end_curves(contexts, fits.train_s, evaluation, config.eval_on)
            if in_full:
                _draw(loggers, config, facts, objects, run_dir)
        evaluation.write(run_dir, run_id=run_id)
        summary.write_summary(run_dir / SUMMARY, facts)
        return facts, objects


def _set_earlier_aside(config: DictConfig, run_dir: Path) -> None:
    taken = [Path(config[name]).resolve() for name in ("ckpt_path", "init_from") if config.get(name)]
    goes_on = any(run_dir.resolve() in (path, *path.parents) for path in taken)
    if set_aside(run_dir, *LEFT[: 1 if goes_on else None]):
        log.info("%s: results of an earlier run are kept as NAME.earlier", run_dir)


def _data(config: DictConfig, known: Measurements | None) -> DataModule:
    """The data, read or known, in coordinates and units of the model that training starts from, if any."""
    path, start = config.ckpt_path, config.get("init_from")
    if path is not None and not Path(path).exists():  # before anything is read or simulated
        raise ValueError(f"ckpt_path={path}: no such file; give an interrupted run's folder or last.ckpt")
    module = datamodule(config.dataset)
    if known is not None:
        module.measurements = known
    module.measurements  # noqa: B018 (read now, so that errors show the path that was typed)
    for key in ("root", "file"):  # absolute, so that a checkpoint finds its data from any folder
        given = None if OmegaConf.is_missing(config.dataset, key) else config.dataset.get(key)
        if given:
            config.dataset[key] = str(Path(given).resolve())
    if start is not None:
        try:
            module.measurements = align_to_site(module.measurements, checkpoint.read(start).site, whole=True)
        except ValueError as error:
            raise ValueError(f"init_from={start}: {error}") from None
    return module


def _resumes(config: DictConfig, folds: int) -> list[Path | None]:
    """What each fold goes on from, a file or a folder; each of several has its own in the run's."""
    path = None if config.ckpt_path is None else Path(config.ckpt_path)
    if path is None or folds == 1:
        return [path] * folds
    run = fitting.run_folder(path, fitting.FOLDS)
    every = [run / f"fold{number}" for number in range(folds)]
    # A file that belongs to no fold says nothing of where the other folds stand.
    if path.is_file() and not {*every} & {*path.parents} and not list(run.glob("fold*")):
        raise ValueError(
            f"ckpt_path={path}: split={config.split.name} has {folds} folds, give the run's folder"
        )
    return [own if own.is_dir() else None for own in every]


def _check(
    config: DictConfig, method: MethodFactory, data: Measurements, split: Split,
    resumes: Sequence[Path | None],
) -> None:  # fmt: skip
    """Refuse now what would be found after the training.

    Raises:
        ValueError: a file of walls, a split or a resume that cannot be.
    """
    _known_walls(config)
    split.check()  # none without rows to learn from or to test on
    if any(resumes) and not method.resumable and not Path(config.ckpt_path).is_dir():  # of finished parts
        raise ValueError(f"ckpt_path: {method.name} trains in one piece; start again without ckpt_path")


def _say(config: DictConfig, method: MethodFactory, data: Measurements, split: Split) -> None:
    """Say what is learned from, and what is guessed."""
    for topic, sentence in summarise(data, split):
        log.info("%-10s%s", topic, sentence)
    for guess in method.guesses:
        log_of_models.info("guess: %s", guess)
    guessed = f", {len(method.guesses)} settings of it guessed" if method.guesses else ""
    steps = config.trainer.max_steps
    how = method.describe_fit(data, Effort().scale_by(config.effort), None if steps == -1 else steps)
    how = f": {how}" if how else ""
    log.info("%-10s%s", "fitting", f"{method.name}{how}{guessed}")


def _known_walls(config: DictConfig) -> Any:
    walls = config.get("known_walls") or OmegaConf.select(config, "init.file")
    return None if walls is None else read_walls(walls)


def _of_folds(whole: FitContext, split: Split, resumes: Sequence[Path | None]) -> list[FitContext]:
    """What the fit of each fold is given."""
    contexts = fold_contexts(whole, split) if len(resumes) > 1 else [whole]
    return [replace(one, resume=resume) for one, resume in zip(contexts, resumes, strict=True)]


@contextmanager
def _advising(contexts: Sequence[FitContext]) -> Iterator[None]:
    """Say of an interrupt among several folds that the run's folder is what to go on from."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        if len(contexts) == 1:
            raise
        cause = str(stopped).partition("; ")[0] or "interrupted"
        raise KeyboardInterrupt(f"{cause}; go on with ckpt_path={contexts[0].run_dir.parent}") from None


def _keep(
    data: Measurements, split: Split, contexts: Sequence[FitContext], run_id: str,
    number: int, fitted: Method, report: FitReport,
) -> None:  # fmt: skip
    """Write the checkpoint of a fold as soon as it is fitted."""
    context = contexts[number]
    for note in report.notes:
        log_of_models.log(logging.WARNING if isinstance(note, Caution) else logging.INFO, "%s", note)
    marks = fitting.run_extra(report, data, split.folds[number], context)
    extra = {**marks, "fold": number, "split_sha256": split.sha256, "run_id": run_id}
    extra["read_notes"] = [] if context.datamodule is None else [*map(str, context.datamodule.notes)]
    checkpoint.save(context.run_dir / checkpoint.MODEL, fitted, context.config_yaml, extra)


def _end_curves(
    contexts: Sequence[FitContext], seconds: Sequence[float], evaluation: Evaluation, eval_on: str
) -> None:
    """End the curve of every fold with its seconds and the error of what was fitted on the rows scored."""
    columns = evaluation.columns
    squared = columns["error_db"] ** 2 if "error_db" in columns else columns.get("mse")
    for number, (context, spent) in enumerate(zip(contexts, seconds, strict=True)):
        own = [] if squared is None else squared[columns["fold"] == number]
        error = float(np.nanmean(own)) if np.isfinite(own).any() else None
        context.log_curve(spent, f"{eval_on} rows", error)


def _as_baseline(config: DictConfig, method: MethodFactory) -> str | None:
    """Its name where a baseline of that name would be fitted in the same way."""
    plainly = config.eval_on != "val" and config.get("stations", "auto") == "auto" and not method.takes_effort
    kind = all_methods().get(method.name)
    same = kind is not None and to_dict(config.model) == config_node(import_target(kind))
    return method.name if plainly and same else None


def _of_fits(fits: FoldFits) -> dict[str, Any]:
    cpu_s = statistics.fmean(fits.train_cpu_s)
    facts: dict[str, Any] = {"time/train_cpu_s": cpu_s}
    said = [note for note in fits.notes if not isinstance(note, Caution)]  # those were warnings
    facts["model/learned"] = "\n".join(said) or None
    if fits.cost.stages:
        facts |= {"time/cost": fits.cost.describe(), "time/unused_s": fits.cost.unused_s}
    return facts


def _draw(
    loggers: list[Any], config: DictConfig, facts: dict[str, Any], objects: TrainedRun, run_dir: Path
) -> None:
    """Draw predictions and what was found; give loggers the pictures, figures and the table."""
    # Under other names, as `time/train_s` would cut off its curve; of the baselines a table.
    numbers = {name: value for name, value in facts.items() if isinstance(value, (int, float))}
    own = {f"final/{name}": v for name, v in numbers.items() if not name.startswith("baseline/")}
    tracking.log_final(loggers, own)
    method, data, fold = objects.methods[0], objects.data, objects.split.folds[0]
    draw_sector_levels(method, data, fold, run_dir / "sectors.png")
    if len(fold.test):
        title = f"{data.site.name}: test rows of {method.label}"
        draw_predictions(method, data, fold, title, run_dir / "test.png")
        tracking.log_picture(loggers, "test rows", run_dir / "test.png")
    table = summary.results_table(facts, str(facts["model/label"]), prefix=config.eval_on)
    tracking.log_table(loggers, "results", *table.texts())
    found = method.objects()
    if len(found):
        draw_found(data, found, run_dir / "found.png", _known_walls(config))
        tracking.log_picture(loggers, "found", run_dir / "found.png")


def _train_and_show(config: DictConfig, run_dir: Path, read: RunInputs, left: str | None) -> None:
    """Train, from what an interrupted try has `left`, and show the table."""
    config.ckpt_path = config.ckpt_path or left
    facts, objects = train(config, run_dir, read)
    made = f"{objects.data.site.name}, split {objects.split.title}"
    drawn = config.split.get("seed") is not None and not objects.split.of_release
    draw = f" (split.seed={config.split.seed})" if drawn else ""
    title = f"{made}{draw}, {config.eval_on}, seed {config.seed}"
    table = summary.results_table(facts, facts["model/label"], title, config.eval_on)
    tested = any(name.startswith(f"{config.eval_on}/") for name in facts)
    worst = worst_stations(objects.evaluation.stations, facts["model/label"])
    show_result(run_dir, *[table, *worst] * tested, lines=summary.remarks(facts, config.eval_on))


def task(config: DictConfig) -> float:
    """Train as configured and show the table; a job of a multirun that is done is not done again.

    Returns:
        The deciding figure, larger is better: ratios of powers as -10 log10, errors with their sign turned;
            NaN where the data, or `split=none`, do not tell it and no search asks.
    """
    hydra, run_dir, job = HydraConfig.get(), run_directory(), in_multirun()
    if config.ckpt_path is not None:
        words = " ".join(hydra.overrides.task)
        log.info("going on with the settings of the interrupted run: %s", words)
    with locked(run_dir / ".job"):  # the run's own is its training's
        unread = State.from_config(config) if job else None  # of a job that is done no data are read
        facts = read_finished(run_dir, unread, config.reuse) if unread else None
        if facts is None:
            read = read_inputs(config)
            what = {"data": measurements_hash(read.module.measurements), "split": read.split.sha256}
            state = replace(unread, **what) if unread else State.from_config(config, **what)
            work = partial(_train_and_show, config, run_dir, read)
            facts = run_once(run_dir, state, work, reuse=config.reuse, again=not job)
        else:
            log.info("%s: already done", run_dir)
    figure = main_figure(facts, config.eval_on)
    value = facts.get(f"{config.eval_on}/{figure}")  # absent where nothing was tested
    if value is not None:
        return score_of(figure, value)
    # A search cannot rank a job without its figure; a plain multirun can do without.
    if job and hydra.runtime.choices["hydra/sweeper"] != "basic":
        raise ValueError(f"{config.eval_on}/{figure}: these data do not tell what the search improves")
    return math.nan  # only a search asks for it


def main() -> None:
    """Run the command."""
    cli.run(task, "train")
