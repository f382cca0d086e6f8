"""The harness: pooling, pairing, skill, time beside every accuracy."""

import dataclasses

import numpy as np
import pytest

from gsparc.base.files import write_samples
from gsparc.evaluation.scores import score_methods
from gsparc.evaluation.summary import describe_dominant_row, results_table, write_summary
from gsparc.models.baselines.idw import InverseDistance
from gsparc.models.baselines.mean import Mean
from gsparc.prediction.timing import ClockSettings
from gsparc.runs.baselines import baselines_for, fit_baseline
from gsparc.runs.evaluate import evaluate
from gsparc.training.context import FitContext

QUICK = ClockSettings(rounds=3, least=2, warmup=1)


def fit_all(make, data, split):
    methods = [make() for _ in split.folds]
    fits = [
        method.fit(data, fold, FitContext())
        for method, fold in zip(methods, split.folds, strict=True)
    ]
    return methods, [fit.seconds for fit in fits]


def evaluated(make, data, split, **more):
    return evaluate(*fit_all(make, data, split), data, split, clock=QUICK, **more)


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_everything_the_contract_lists(campaign, folds, tmp_path, kind):
    data, split = campaign(kind, 40), folds(40)
    found = evaluated(InverseDistance, data, split)
    facts = found.facts
    own = {
        "spectrum": {"ssim", "ssim_median", "ssim_gauss", "psnr_db", "mse", "mae", "nmse"},
        "csi": {"nmse", "nmse_scalar", "snr_db"},
        "rssi": {"rmse_db", "mae_db", "nmse"},
    }[kind]
    plain = baselines_for(data, split)
    for figure in own | {"skill"}:
        assert f"test/{figure}" in facts
        assert all(f"baseline/{name}/{figure}" in facts for name in plain)
    for name in plain:
        assert (
            facts[f"baseline/{name}/train_s"] >= 0 and facts[f"baseline/{name}/render_ms_p50"] > 0
        )
    for key in (
        "time/train_s",
        "time/render_ms_p50",
        "time/render_ms_p95",
        "time/render_ms_batch64",
        "time/ratio_to_copy",
        "time/includes",
        "machine/threads",
        "machine/load",
        "machine/cpu",
        "model/num_gaussians",
        "model/effects",
        "memory/peak_mb",
        "dataset/name",
        "dataset/sha256",
        "dataset/stand_in",
        "dataset/convergence_error",
        "split/name",
        "split/sha256",
    ):
        assert key in facts, key
    assert facts["time/render_ms_p95"] >= facts["time/render_ms_p50"] > 0
    write_summary(tmp_path / "summary.json", facts)
    write_samples(tmp_path / "per_sample.csv", found.columns)
    assert len((tmp_path / "per_sample.csv").read_text().splitlines()) == 1 + len(
        split.folds[0].test
    )
    if kind == "rssi":
        errors = found.columns["predicted_db"] - found.columns["measured_db"]
        assert np.allclose(errors, found.columns["error_db"])


def test_samples_had_the_nmse_of_baselines_and_none_of_the_method(campaign, folds):
    data, split = campaign("csi", 40), folds(40)
    found = evaluated(InverseDistance, data, split, baselines=["idw"])
    assert found.columns["nmse"].mean() == pytest.approx(found.facts["test/nmse"])
    np.testing.assert_array_equal(found.columns["nmse"], found.columns["baseline/idw/nmse"])


def test_a_method_that_is_a_baseline_too_was_fitted_twice(campaign, folds, monkeypatch):
    """`model=gp` was fitted again as its own baseline, for a second row of equal figures."""
    data, split = campaign("rssi", 40), folds(40)
    methods, seconds = fit_all(InverseDistance, data, split)
    monkeypatch.setattr(InverseDistance, "fit", lambda *unused: pytest.fail("fitted again"))
    names = ["mean", "idw"]
    facts = evaluate(
        methods, seconds, data, split, clock=QUICK, baselines=names, shared="idw"
    ).facts
    assert facts["baseline/idw/rmse_db"] == facts["test/rmse_db"]
    assert facts["baseline/idw/train_s"] == facts["time/train_s"]
    assert [row[0] for row in results_table(facts, "idw").rows] == ["mean", "idw"]
    facts["baseline/idw/rmse_db"] += 1  # fitted otherwise, a row of its own
    assert [row[0] for row in results_table(facts, "idw").rows] == ["mean", "idw (baseline)", "idw"]


def test_one_strong_row_made_most_of_the_figures_of_powers(campaign, folds):
    """`nmse`, `skill` and a warning were of linear powers: the strongest row, measured right,
    was all.
    """
    data, split = campaign("rssi", 60), folds(60)
    target = data.target.copy()
    target[int(split.folds[0].test[2])] *= 1e6
    facts = evaluated(InverseDistance, dataclasses.replace(data, target=target), split).facts
    squares = [facts[f"{one}/rmse_db"] ** 2 for one in ("test", "baseline/nearest")]
    assert facts["test/skill"] == pytest.approx(1 - squares[0] / squares[1])
    assert not any("decided_by" in key for key in facts) and not describe_dominant_row(facts)
    heads, _ = results_table(facts, "idw").texts()
    assert heads == ["method", "rmse_db", "mae_db", "skill", "train s/fold", "query ms p50"]


def test_folds_are_pooled(campaign, folds, monkeypatch):
    data, split = campaign("spectrum", 45), folds(45, 5)
    methods, seconds = fit_all(Mean, data, split)
    for steps, method in enumerate(methods):
        monkeypatch.setattr(method, "facts", lambda steps=steps: {"model/steps_taken": steps})
    scores = score_methods(methods, data, split)
    assert sorted(scores.row) == list(range(45)) and list(np.unique(scores.fold)) == [0, 1, 2, 3, 4]
    first = score_methods(methods[:1], data, dataclasses.replace(split, folds=split.folds[:1]))
    assert np.array_equal(scores.samples["ssim"][:9], first.samples["ssim"])
    facts = evaluate(methods, seconds, data, split, baselines=("nearest", "gp"), clock=QUICK).facts
    assert facts["test/ssim"] == pytest.approx(scores.samples["ssim"].mean())
    assert facts["model/steps_taken"] == 2, "the mean, not the first fold's"
    assert facts["split/folds"] == 5 and facts["test/samples"] == 45
    assert facts["time/train_total_s"] == pytest.approx(5 * facts["time/train_s"])


@pytest.mark.parametrize("name", ["nearest", "gp"])
def test_baselines_have_not_seen_the_rows_they_are_scored_on(campaign, folds, name):
    data, split = campaign("csi", 40), folds(40)
    for subset in ("test", "val"):
        assert fit_baseline(name, data, split, subset).scores.figures()["nmse"] > 0.001
    assert fit_baseline(name, data, split, "test").methods[0].count_components() == 30
    assert fit_baseline(name, data, split, "val").methods[0].count_components() == 27


def test_a_method_of_seconds_a_query_is_not_timed_in_batches(campaign, folds, monkeypatch):
    """Ray marching took ten minutes to be timed in batches of 64."""
    monkeypatch.setattr("gsparc.runs.evaluate.SLOWEST_BATCH_MS", 0.0)
    facts = evaluated(Mean, campaign("spectrum", 40), folds(40), baselines=()).facts
    assert facts["time/render_ms_batch64"] is None and facts["time/render_ms_p50"] > 0


def test_a_row_that_decides_sums_is_named_beside_a_median(campaign, folds, tmp_path):
    """NMSE was 7e13 by one row, without a word."""
    data, split = campaign("csi", 60), folds(60)
    methods, seconds = fit_all(InverseDistance, data, split)
    quiet = evaluate(methods, seconds, data, split, baselines=(), clock=QUICK).facts
    assert not any("decided_by" in key for key in quiet) and not describe_dominant_row(quiet)
    row, target = int(split.folds[0].test[2]), data.target.copy()
    target[row] *= 1e6
    loud = dataclasses.replace(data, target=target)
    facts = evaluate(methods, seconds, loud, split, baselines=(), clock=QUICK).facts
    assert facts["test/decided_by/row"] == row and facts["test/decided_by/share"] > 0.999
    assert 0 < facts["test/decided_by/nmse_median"] < 3
    assert describe_dominant_row(facts)[0].startswith(
        f"row {row} alone makes 100.0% of the error or power"
    )
    write_summary(tmp_path / "summary.json", facts)
