"""Read data, split them, fit a method, test it, write: what `train.py` and `gsparc train` do."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.base.files import SUMMARY
from gsparc.commands.shared import cli
from gsparc.data.split_files import write_split
from gsparc.evaluation.provenance import new_run_id, provenance
from gsparc.evaluation.summary import write_summary
from gsparc.models.array_vectors.vector_cache import forget_vectors
from gsparc.pictures.pictures import draw_and_log_run
from gsparc.runs.baselines import same_as_baseline
from gsparc.runs.evaluate import TrainedRun, evaluate
from gsparc.runs.experiment import folds, options
from gsparc.runs.experiment.runner import Job
from gsparc.runs.inputs import RunInputs, describe_inputs, objective, read_inputs, train_once
from gsparc.runs.ledger import set_earlier_aside
from gsparc.runs.output import show_training
from gsparc.runs.run_lock import locked
from gsparc.training import tracking
from gsparc.training.context import FitContext


def train(
    config: DictConfig, run_dir: Path, inputs: RunInputs | None = None, *, in_full: bool = True
) -> tuple[dict[str, Any], TrainedRun]:
    """Fit a method on every fold of a split, test it beside baselines, and write it all down.

    The folder is locked meanwhile; files of an earlier run there, which this one does not go on
    from, are moved aside.

    Args:
        config: as composed from conf/train.yaml.
        run_dir: where checkpoints, curves, pictures and `summary.json` go.
        inputs: what it begins with, where that was read before.
        in_full: whether it says what it learns from, times queries and draws pictures, too.

    Returns:
        The facts of `summary.json`, and the objects they were computed from.

    Raises:
        ValueError: bad data, settings or checkpoint, one line each; or another run writes there.
    """
    with locked(run_dir):
        set_earlier_aside(run_dir, config.ckpt_path, config.get("init_from"))
        inputs = inputs or read_inputs(config)
        data, split, method, run_id = inputs.data, inputs.split, inputs.method, new_run_id()
        learned = inputs.errors.learned(data, split)
        resumes = folds.folds_to_resume(config.ckpt_path, method, split)
        if in_full:
            describe_inputs(config, inputs)
        write_split(run_dir / "split.json", split, len(data), data.site.sha256, run_id)
        with tracking.open_loggers(config) as loggers:
            whole = FitContext(
                **folds.effort_settings(config),
                run_dir=run_dir,
                init_from=config.get("init_from") and Path(config.init_from),
                datamodule=inputs.module,
                batch_size=config.dataset.get("batch_size", 16),
                # Each stage of a fit makes its own
                trainer=instantiate(config.trainer, _partial_=True),
                callbacks=partial(folds.build_callbacks, config.get("callbacks")),
                loggers=loggers,
                config_yaml=OmegaConf.to_yaml(config, resolve=True),
            )
            contexts = folds.fold_contexts(whole, split, resumes)
            # `Method.fit` of every fold; models/{splat/method,peers/trained}.py call `Trainer.fit`.
            keep = partial(folds.save_fold_checkpoint, split, contexts, run_id)
            fits = folds.fit_folds(method, *(learned or (data, split)), contexts, keep=keep)
            unused = options.warn_of_unheeded(config, fits.methods[0], data) if in_full else None
            how: dict[str, Any] = {"eval_on": config.eval_on, "baselines": config.baselines}
            how |= {"shared": same_as_baseline(config, method), "timed": in_full}
            asked, how["learned"] = inputs.errors.asked(data, split), learned
            evaluation = evaluate(fits.methods, fits.train_s, asked, split, **how)
            folds.end_curves(contexts, fits.train_s, evaluation.columns, config.eval_on)
            facts = {**evaluation.facts, **provenance(), **fits.facts(), "run_id": run_id}
            facts |= {"seed": int(config.seed), "options/unused": unused}
            run = TrainedRun(fits.methods, folds.checkpoints(contexts), data, split, evaluation)
            if in_full:
                draw_and_log_run(run, inputs.walls, facts, config.eval_on, run_dir, loggers)
        evaluation.write(run_dir, run_id=run_id)
        write_summary(run_dir / SUMMARY, facts)
        return facts, run


def train_job(job: Job, resume_from: str | None) -> None:
    """Train a job into its folder, from the checkpoint that an interrupted try left."""
    config = deepcopy(job.config)
    # Solved for another job, they would be missing from this one's processor seconds
    forget_vectors()
    config.ckpt_path = config.ckpt_path or resume_from  # what the settings name to go on from wins
    inputs = replace(read_inputs(config, job.data), split=job.split)
    _, trained_run = train(config, job.folder, inputs, in_full=False)
    for file in () if job.keeps_models else trained_run.checkpoints:
        file.unlink()


def train_and_show(config: DictConfig, run_dir: Path, inputs: RunInputs) -> None:
    """Train, and show the table."""
    facts, trained_run = train(config, run_dir, inputs)
    show_training(config, run_dir, facts, trained_run.split, trained_run.evaluation.stations)


def task(config: DictConfig) -> float:
    """Train as configured, show the table, and return what a search improves, see `objective`."""
    return objective(config, train_once(config, train_and_show))


def main() -> None:
    """Run the command."""
    cli.run(task, "train")
