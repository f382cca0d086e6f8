"""Risk and coverage, thresholds with a promise, and whether promises hold."""

import re
from dataclasses import replace

import numpy as np
import pytest
from campaigns import brief, compose, plain, spectra
from refusals import refused

from gsparc.commands.calibrate import calibration_tables
from gsparc.commands.evaluate import evaluate_files
from gsparc.commands.train import train
from gsparc.pictures.pictures import draw_calibration
from gsparc.prediction.confidence import Guarantee, Trusted, as_confidence
from gsparc.prediction.left_out import Evidence
from gsparc.prediction.risk import (
    Trial,
    calibrate_threshold,
    calibration_facts,
    explain_too_few,
    number_patches,
    run_trials,
    split_choose_calibrate_test,
)
from gsparc.processes.uncertainty import least_accepted
from gsparc.runs.unseen import Unseen


def _evidence(count: int = 900, seed: int = 0) -> Evidence:
    """Errors grow with the distance from the middle; `expected` knows it up to noise,
    `learned` does not.
    """
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1, 1, (count, 3))
    error = 10 ** (-2 + 2 * np.linalg.norm(position[:, :2], axis=1) + rng.normal(0, 0.3, count))
    scores = {
        "expected": -np.linalg.norm(position[:, :2], axis=1) + rng.normal(0, 0.1, count),
        "learned": rng.normal(size=count),
    }
    return Evidence(np.arange(count), position, error, scores)


def test_few_good_rows_promised_nothing_as_no_level_accepted_enough() -> None:
    """The laxest of levels from six scores mostly accepts fewer than eleven of thirteen others."""
    good, promise = replace(_evidence(32), error=np.full(32, 0.01)), Guarantee(0.0, alpha=0.2)
    accepted = [
        calibrate_threshold(good, promise, "auto", False, seed)[1].accepted for seed in range(50)
    ]
    assert min(accepted) >= least_accepted(0.2, 0.1)  # 19 of 50 accepted none
    assert explain_too_few(13, promise).startswith(
        "13 test positions are too few: alpha=0.2, delta=0.1 with"
    )
    assert explain_too_few(14, promise) is None and "44 in all" in explain_too_few(32, promise, 0.1)
    assert explain_too_few(13, promise, 0.9) == explain_too_few(13, promise)


def test_a_bound_that_no_threshold_keeps_came_without_a_hint(monkeypatch) -> None:
    evidence, kept = _evidence(), []
    monkeypatch.setattr("gsparc.runs.unseen.store_trusted", lambda *stored: kept.append(stored))
    how, unseen = (
        ("auto", False, 0),
        Unseen("a.ckpt", {}, Trusted(), evidence.position, evidence),
    )
    stored, said = unseen.calibrate_and_store(Guarantee(-40.0), *how)
    # Another confidence replaced the model's own though nothing was promised.
    assert "confidence stays the model's own, the checkpoint is unchanged; " in said and not kept
    assert stored.threshold == np.inf and "100% of 900 test positions are worse than -40 dB" in said
    better = float(re.search(r"limit_db=(\S+) would be kept", said)[1])
    assert -25 < better < 0
    stored, said = unseen.calibrate_and_store(Guarantee(better), *how)
    assert "confidence=expected, before: the model's own; accepted from" in said and len(kept) == 1
    assert re.search(
        r"accepted from \S+, \d+% of 900 test positions: at most 10% of the accepted are", said
    )
    assert said.endswith("which fails in at most 10% of cases; threshold stored in a.ckpt")
    assert "no threshold" in unseen.calibrate_and_store(Guarantee(better - 1), *how)[1]
    # Fewer than alpha were bad, and a confidence was blamed;
    # rows of patches that err together were too few.
    evidence.error[:] = np.where(np.arange(900) % 8 == 0, 10.0, 0.01)
    said = unseen.calibrate_and_store(Guarantee(alpha=0.144), "auto", False, 2)[1]
    assert "too few rows to show that at most alpha=0.144 are" in said
    evidence.error[:] = np.where(number_patches(evidence.position) % 8 == 0, 10.0, 0.01)
    said = unseen.calibrate_and_store(Guarantee(alpha=0.2), "learned", True, 0)[1]
    assert "as neighbours err alike" in said
    evidence.error[:] = 10.0
    assert "no limit_db= up to 6 is kept" in unseen.calibrate_and_store(Guarantee(), *how)[1]


@pytest.mark.parametrize("how", ["random", "spatial"])
def test_promise_holds_over_two_hundred_calibration_sets(how) -> None:
    trial = run_trials(
        _evidence(), Guarantee(limit_db=-5, alpha=0.2, delta=0.1), how == "spatial", 200
    )
    facts = trial.summarise()
    assert trial.kind == "expected" and trial.coverage.mean() > 0.2
    # Resampled from one pool: the share itself scatters by about 0.02.
    # Test cells are few and unlike: what is realised in them scatters more
    # than the promise's own doubt.
    assert facts["broken"] <= (0.16 if how == "random" else 0.2)
    assert facts["realised"] < 0.2


MUTE = Trial("learned", "random", np.full(3, np.nan), np.zeros(3), 0.1)


def test_a_picture_of_nobody_accepted(tmp_path) -> None:
    """Nothing to divide by is no reason to draw nothing."""
    draw_calibration(_evidence(), [MUTE], Guarantee(), "silent", tmp_path / "confidence.png")
    assert (tmp_path / "confidence.png").stat().st_size > 1000


def test_few_positions_or_patches_are_refused_in_words() -> None:
    """Two clusters, or two rows, ended in an index out of bounds."""
    rng = np.random.default_rng(0)
    two = _evidence(40)
    two.position[:] = np.where(np.arange(40)[:, None] < 20, 0.0, 5.0)
    assert len(split_choose_calibrate_test(two, False, rng)[2]) == 16
    with pytest.raises(
        ValueError, match=r"2 patches of the plane cannot be parted .* spatial=false"
    ):
        split_choose_calibrate_test(two, True, rng)
    refused("2 positions cannot be parted", split_choose_calibrate_test, _evidence(2), False, rng)


def test_a_model_without_variance_or_confidence_is_refused(tmp_path) -> None:
    data = spectra(tmp_path / "own.npz")
    path = train(plain(data, "mean"), tmp_path / "run")[1].checkpoints[0]
    how = Guarantee(), "auto", False, 0
    unseen = Unseen.open(str(path), {}, {})
    refused("neither an error variance nor a confidence", unseen.calibrate_and_store, *how)


def test_positions_on_a_plumb_line_have_patches() -> None:
    upright = _evidence(60)
    upright.position[:, :2] = 1.0
    assert len(np.unique(number_patches(upright.position))) == 6


def test_predictions_without_any_error_have_no_correlation() -> None:
    """Predictions without any error: 0 / 0 ended the command."""
    exact = replace(_evidence(30), error=np.zeros(30))
    facts = calibration_facts(exact, [], Guarantee())
    assert facts["confidence/learned/rank_correlation"] is None
    assert len(calibration_tables(facts | {"dataset/name": "d", "model/name": "m"})[0].rows) == 2


def test_trials_beside_a_promise_of_other_trials_read_as_a_broken_one() -> None:
    """14% of accepting trials stood beside a promise about all;
    fewer answers than above had no reason.
    """
    promise = Guarantee(limit_db=-5, alpha=0.2)
    facts = calibration_facts(_evidence(), [run_trials(_evidence(), promise, False, 5)], promise)
    trials = calibration_tables(facts | {"dataset/name": "d", "model/name": "m"})[1]
    heads = [column.name for column in trials.columns]
    at = heads.index("failed, of all trials")
    told = ["promised: at most", "failed, of accepting trials: no promise"]
    assert heads[at + 1 :] == told
    assert trials.note == "Trials calibrate on 40% of the rows, the stored threshold on 80%"


def _trained(folder, *more: str, run: str = "run"):
    """A process of forty spectra."""
    return train(plain(spectra(folder / "own.npz"), "gp", *more), folder / run)[1]


@pytest.mark.slow
def test_an_interrupted_training_calibrates_and_scores_its_own_rows_alone(tmp_path) -> None:
    """`last.ckpt` and `refit/last.ckpt` took any split for their own: 38 dB where 29 were true."""
    file = spectra(tmp_path / "own.npz")
    often = "callbacks.checkpoint.interval=10"
    _, objects = train(compose(*brief(file, often)), tmp_path / "run")
    for path in (tmp_path / "run" / "last.ckpt", tmp_path / "run" / "refit" / "last.ckpt"):
        assert len(Unseen.open(str(path), {}, {}).evidence) == len(objects.split.folds[0].test)
        found, _, _ = evaluate_files([path], split={"redraw": True, "seed": 5})
        assert re.match(
            r"another split \(random\): [1-9]\d* of these 8 test", found.facts["split/foreign"]
        )
        with pytest.raises(
            ValueError, match=r"test rows were TRAINED on; calibrate with the data and split"
        ):
            Unseen.open(str(path), {}, {"name": "sparse"})


def test_the_same_campaign_in_another_file_calibrates_nothing_that_was_learned(tmp_path) -> None:
    """Reordered, cut or repeated rows were taken with a warning; a new campaign may calibrate."""
    rng = np.random.default_rng(0)
    objects = _trained(tmp_path)
    with np.load(tmp_path / "own.npz") as stored:
        arrays = dict(stored)
    path, count = str(objects.checkpoints[0]), len(arrays["spectrum"])

    def written(name: str, rows: np.ndarray, shift: float | np.ndarray = 0.0) -> dict[str, str]:
        moved = {
            "spectrum": arrays["spectrum"][rows],
            "tx_position": arrays["tx_position"][rows] + shift,
        }
        np.savez(tmp_path / f"{name}.npz", **{**arrays, **moved})
        return {"file": str(tmp_path / f"{name}.npz")}

    every = np.arange(count)
    wrong = {
        "reordered": written("reordered", rng.permutation(count)),
        "fewer": written("fewer", every[:-1]),
        "more": written("more", np.append(0, every), np.append(1.0, 0 * every)[:, None]),
        "moved by less than its accuracy": written("moved", rng.permutation(count), 1e-7),
    }
    for name, file in wrong.items():
        with pytest.raises(
            ValueError, match=r": [1-9]\d* of these \d+ test rows are at places that were TRAINED"
        ):
            Unseen.open(path, file, {})
            pytest.fail(name)
    elsewhere = written("elsewhere", every, 0.05)
    again = Unseen.open(path, elsewhere, {"name": "random"}).evidence
    assert len(again) == len(objects.split.folds[0].test)
    (tmp_path / "own.npz").unlink()
    with pytest.raises(
        ValueError, match=r"\(content hashes differ\); these test rows may have been TRAINED on"
    ):
        Unseen.open(path, elsewhere, {})


def test_another_file_was_calibrated_on_a_fifth(tmp_path) -> None:
    path = str(_trained(tmp_path).checkpoints[0])
    with np.load(tmp_path / "own.npz") as stored:
        arrays = dict(stored)
    arrays["tx_position"] = arrays["tx_position"] + 0.05
    np.savez(tmp_path / "later.npz", **arrays)
    other = {"file": str(tmp_path / "later.npz")}
    unseen = Unseen.open(path, other, {"name": None})
    evidence, facts = unseen.evidence, unseen.facts
    assert len(evidence) == len(arrays["tx_position"]) and facts["split/name"] == "whole"
    assert facts["split/foreign"] is None  # nothing of it was learned from
    assert len(unseen.known) == 32
    trusted, _ = unseen.calibrate_and_store(Guarantee(), "expected", False, 0)
    assert trusted.covers(evidence.position).all()


def test_a_threshold_of_expected_errors_accepted_none_of_the_test_positions(tmp_path) -> None:
    """`accepted from 0.9933, 0% of 64`: scores were compared with a confidence."""
    path = str(_trained(tmp_path).checkpoints[0])
    unseen = Unseen.open(path, {}, {})
    evidence = unseen.evidence
    trusted, said = unseen.calibrate_and_store(Guarantee(60, 0.4, 0.4), "expected", False, 0)
    accepted = np.mean(as_confidence("expected", evidence.scores["expected"]) >= trusted.threshold)
    assert accepted > 0 and f", {accepted:.0%} of {len(evidence)} test positions" in said


def test_rows_that_were_learned_from_calibrate_nothing(tmp_path) -> None:
    """With another split, or one whose file is gone,
    a threshold was chosen on rows that were fitted to.
    """
    objects = _trained(tmp_path)
    path, rows = str(objects.checkpoints[0]), len(objects.split.folds[0].test)
    assert len(Unseen.open(path, {}, {}).evidence) == rows
    with pytest.raises(
        ValueError, match=r"test rows were TRAINED on; calibrate with the data and split"
    ):
        Unseen.open(path, {}, {"name": "corner"})
    split = tmp_path / "run" / "split.json"
    path = str(_trained(tmp_path, "split=file", f"split.path={split}", run="other").checkpoints[0])
    assert len(Unseen.open(path, {}, {}).evidence) == rows
    other = split.rename(tmp_path / "kept.json")
    assert Unseen.open(path, {}, {"path": str(other)}).facts["split/foreign"] is None  # by its hash
    with pytest.raises(ValueError, match="another split; these test rows may have been TRAINED on"):
        Unseen.open(path, {}, {"name": "corner"})
