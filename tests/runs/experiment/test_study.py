"""Each variant's accuracy, seconds and milliseconds, under every condition of the data."""

import pytest
from invented import divide, invent
from omegaconf import OmegaConf
from refusals import refused

from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.metric_formats import main_figure
from gsparc.evaluation.scores import score_methods
from gsparc.evaluation.summary import write_summary
from gsparc.models import checkpoint
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.baselines.mean import Mean
from gsparc.prediction.timing import ClockSettings
from gsparc.runs.experiment.runner import Job, run_jobs
from gsparc.runs.experiment.study import DataChanges, average_rounds, plan_rounds
from gsparc.training.context import FitContext

CLOCK = ClockSettings(rounds=10, rounds_s=2)
AS_IT_IS = DataChanges("").conditions()
METHODS = {"gp": GaussianProcess, "mean": Mean}


def fit(job: Job, left: str | None) -> None:
    """Fit a job's method and write what a training does of it."""
    if job.config.model == "impossible":
        raise ValueError("model.effects.array=true is not possible: no array")
    methods = []
    for number, fold in enumerate(job.split.folds):
        data, rows = (job.data, fold) if job.learned is None else job.learned(job.data, fold)
        methods.append(METHODS[job.config.model]())
        methods[-1].fit(data, rows, FitContext(seed=job.config.seed))
        part = "" if len(job.split.folds) == 1 else f"fold{number}/"
        checkpoint.save(job.folder / f"{part}model.ckpt", methods[-1], "", {})
    figures = pool_figures(score_methods(methods, job.data, job.split), job.data, job.split)
    facts = {f"test/{name}": value for name, value in figures.items()} | {
        "dataset/kind": job.data.site.scored
    }
    times = {
        "time/train_s": 1.0 + job.config.seed,
        "time/train_cpu_s": 1.0,
        "seed": job.config.seed,
    }
    write_summary(job.folder / "summary.json", facts | times | {"model/name": job.config.model})
    assert main_figure(facts)


def run(folder, names, conditions=AS_IT_IS, rounds=1, data=None, split=None):
    """The table of a study, and its fits."""
    data, split = data or invent(), split or divide(48)
    configs = {name: OmegaConf.create({"model": name, "seed": 3}) for name in names}
    fits = run_jobs(plan_rounds(configs, conditions, rounds, data, split, folder), fit)
    return average_rounds(fits, conditions, CLOCK), fits


@pytest.mark.slow
def test_what_cannot_be_is_left_out_and_every_round_has_another_seed_once(tmp_path, caplog):
    caplog.set_level("INFO")
    rows, fits = run(tmp_path, ["mean", "impossible", "gp"], rounds=2, split=divide(48, 2))
    assert (
        list(rows.variant) == ["mean", "gp"] and "impossible, round 1 is left out: " in caplog.text
    )
    assert list(fits.seed) == [3, 3, 4, 4] and list(rows.train_s) == [4.5, 4.5]
    assert rows.spread[0] == 0 and rows.rows[0] == 24 and (rows.query_ms > 0).all()
    caplog.clear()
    run(tmp_path, ["mean", "gp"], rounds=2, split=divide(48, 2))
    assert "4 cells, 4 already done" in caplog.text
    refused("not possible", run, tmp_path, ["impossible"])


@pytest.mark.slow
def test_errors_cost_an_interpolator_and_not_the_mean(tmp_path):
    conditions = DataChanges("", errors_m=[0.001, 0.3]).conditions()
    rows, fits = run(tmp_path, ["gp", "mean"], conditions)
    value = {(r.variant, r.what, r.amount): r.value for r in rows.itertuples()}
    assert len(value) == 14 and len(fits) == 10  # one training serves all queries
    for what in ("query", "train"):
        assert value["gp", what, 0.3] < value["gp", "none", 0.0] - 1
        assert abs(value["mean", what, 0.3] - value["mean", "none", 0.0]) < 1e-6
    clean, asked = (
        next(r for r in rows.itertuples() if r.what == what) for what in ("none", "query")
    )
    # Trained and timed once
    assert (clean.train_s, clean.query_ms) == (asked.train_s, asked.query_ms)


def test_more_measurements_are_better_and_are_counted(tmp_path):
    rows, _ = run(tmp_path, ["gp"], DataChanges("", keep=[1, 0.5, 9]).conditions())
    assert list(rows.rows) == [36, 18, 9]
    values = list(rows.value)
    assert values == sorted(values, reverse=True) and values[0] > values[-1] + 1
    refused("keep=", DataChanges, "", keep=[0.0])
