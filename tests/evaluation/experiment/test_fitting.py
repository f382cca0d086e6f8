"""Cells of a comparison: what names one, what is found again, what is not."""

from __future__ import annotations

import errno
import json

import pytest
from hydra import initialize_config_module

from gsparc.evaluation.experiment import fitting
from gsparc.evaluation.experiment.cells import Cell, Contender
from gsparc.evaluation.experiment.fitting import Filled, Prepared, fill_all, prepare
from gsparc.evaluation.experiment.latency import timed_here
from gsparc.evaluation.experiment.problem import (
    Problem,
    SplitChoice,
    _may_match,
    stored_problems,
)
from gsparc.models.checkpoint import CheckpointError


def test_kept_timings_stand_where_models_are_not_here(tmp_path, caplog):
    """Results travel as text, models do not: their timings must not be replaced by those of a few."""
    kept = {"gp": {"p50_ms": 1.5, "p95_ms": 2.0, "to_copy": 0.5, "rounds": 60}}
    (tmp_path / "latency-toy.json").write_text(json.dumps(kept))
    cells = [Filled(Cell("toy", "random", "gp", None, None), tmp_path / "gp", {})]
    assert timed_here(cells, {}, tmp_path, measure=True)["toy"]["gp"].p50_ms == 1.5
    assert "models of gp are not here" in caplog.text
    assert timed_here(cells, {}, tmp_path / "none", measure=True) == {"toy": {}}


def test_results_of_an_earlier_program_are_found_for_the_same_data_only(tmp_path):
    """Published cells would vanish from the table with every edit of a method."""
    cell = Cell("toy", "random", "gp", None, None)
    problem = Problem("toy", "random", "spectrum", ("d", "s", "i"))
    prepared = Prepared(cell, problem, None, tmp_path / "toy-random-gp-today")
    facts = {
        "seed": None, "budget_s": None, "git": "0123456789",
        "dataset/kind": "spectrum", "dataset/sha256": "d", "split/sha256": "s",
    }  # fmt: skip

    def write(name: str, **changes: str) -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "cell.json").write_text(json.dumps({**facts, **changes}))

    write("toy-random-gp-other", **{"dataset/sha256": "e"})
    write("toy-random-gp-grid", **{"dataset/identity": "of another grid"})
    write("toy-random-gp-cut")
    (tmp_path / "toy-random-gp-cut" / "cell.json").write_text("{")
    assert prepared.result() is None and prepared.old_result() is None
    write("toy-random-gp-old", made="2026-01-01")
    write("toy-random-gp-newer", made="2026-01-02", git="abcdefghijk")
    found = prepared.old_result()
    assert found.earlier == "abcdefgh" and found.folder.name == "toy-random-gp-newer"
    write("toy-random-gp-today")
    assert prepared.result().earlier is None
    random, sparse = SplitChoice("random"), SplitChoice("sparse")
    for name in ("old", "newer", "today"):
        kept = {**facts, "dataset/identity": "i"}
        (tmp_path / f"toy-random-gp-{name}" / "cell.json").write_text(json.dumps(kept))
    assert stored_problems(tmp_path, "toy", [random, sparse]) == [problem]
    assert not stored_problems(tmp_path, "t", [random])


def test_kept_results_of_draws_are_a_problem_each(tmp_path):
    for draw, folds in enumerate(("s0", "s1")):
        facts = {"seed": draw, "dataset/kind": "rssi", "dataset/sha256": "d", "split/sha256": folds}
        (tmp_path / f"toy-drawn-gp-{draw}").mkdir()
        (tmp_path / f"toy-drawn-gp-{draw}" / "cell.json").write_text(json.dumps(facts))
    found = stored_problems(tmp_path, "toy", [SplitChoice("drawn", draws=3)])
    assert [(p.draw, p.hashes[1]) for p in found] == [(0, "s0"), (1, "s1")]


def prepared(folder, model="gsparc", budget_s=5.0, seed=0, settings=None, choose=()):
    """A cell as it is before it is filled."""
    problem = Problem("own", "random", "spectrum", ("d", "s", "i"))
    contender = Contender(model, (f"model={model}", *choose), ("budget_s={budget_s}",))
    cell = Cell("own", "random", model, budget_s, seed)
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return prepare(cell, contender, {"file": "x", **(settings or {})}, problem, folder)


@pytest.mark.parametrize(
    "changes",
    [
        # A model was trained as if there were no budget: one of 5 s was found again as one of 60 s.
        [{"model": "gsparc"}, {"model": "gsparc", "budget_s": 60.0}],
        [{"model": "moving_array"}, {"model": "moving_array", "budget_s": 60.0}],
        # The first seed of gsparc stood for all three: a spread of 0.00.
        [{"model": "gsparc", "seed": seed} for seed in range(3)],
        [{"model": "moving_array", "seed": seed} for seed in range(3)],
        # These settings stand beside the model's: a table of batches of 4 showed cells of batches of 16.
        [{}, {"settings": {"batch_size": 4}}],
        [{}, {"choose": ("budget_clock=processor",)}],
        [{}, {"choose": ("init_from=model.ckpt",)}],
    ],
)
def test_a_cell_was_taken_for_one_of_another_batch_clock_or_start(changes, tmp_path):
    found = [prepared(tmp_path, **change) for change in changes]
    assert len({one.folder for one in found}) == len(changes) and found[0].config.budget_s == 5


def test_a_cell_was_taken_for_one_of_other_walls_in_a_file_of_that_name(tmp_path):
    walls, folders = tmp_path / "walls.json", set()
    for text in ("[]", "[1]"):
        walls.write_text(text)
        folders.add(prepared(tmp_path, choose=("init=scene", f"init.file={walls}")).folder)
    assert len(folders) == 2


def test_a_full_disk_ends_a_comparison(campaign, folds, tmp_path, monkeypatch):
    """Every further cell was trained in vain; then `no cell is filled (train=true fills them)`."""
    tried = []

    def full(prepared):
        tried.append(prepared)
        raise CheckpointError("m.ckpt: cannot be written") from OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(fitting, "fill", full)
    data = campaign("spectrum", 20)
    problem = Problem("toy", "random", "spectrum", ("d", "s", "i"), data=data, folds=folds(20))
    cells = [Cell("toy", "random", method, None, None) for method in ("mean", "gp")]
    with pytest.raises(CheckpointError, match="cannot be written"):
        fill_all([Prepared(one, problem, None, tmp_path / one.method) for one in cells])
    assert len(tried) == 1


@pytest.mark.parametrize(
    ("pattern", "rfid", "newrf"),
    [
        ("*/gp/*", True, True),  # one star stands for dataset and split: rooms were left out without a word
        ("newrf/*", False, True),
        ("new*/60/0", False, True),
        ("rfid/random/gp/any/any", True, False),
        ("*", True, True),
        ("rfid/sparse/*", False, False),
    ],
)
def test_a_star_may_stand_for_several_parts_of_a_cell(pattern, rfid, newrf):
    assert _may_match(pattern, "rfid", "random") == rfid
    assert _may_match(pattern, "newrf", "random") == newrf
