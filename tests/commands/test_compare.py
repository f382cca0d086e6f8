"""The command: fills what is missing, finds what is there, goes on after a failure."""

from __future__ import annotations

import errno
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import spectra
from hydra import initialize_config_module

from gsparc.commands import compare as command
from gsparc.commands.run_lock import held
from gsparc.evaluation.experiment import fitting
from gsparc.evaluation.experiment.cells import Cell, Contender
from gsparc.evaluation.experiment.fitting import Filled, Prepared, fill_all, prepare
from gsparc.evaluation.experiment.latency import Latency, timed_here
from gsparc.evaluation.experiment.problem import (
    Problem,
    SplitChoice,
    _may_match,
    stored_problems,
)
from gsparc.models.checkpoint import CheckpointError

ROOT = Path(__file__).parents[2]
FILLED = re.compile(r"own/\S+: \S+ dB after ")  # a line of each cell


def compare(tmp_path, *more: str) -> subprocess.CompletedProcess:
    words = [
        sys.executable, "-m", "gsparc", "compare", f"+datasets.own.file={tmp_path / 'own.npz'}",
        "splits.random.datasets=[own]", "budgets=[{seconds: 0.3, seeds: [0]}]", f"cells={tmp_path / 'cells'}",
        f"hydra.run.dir={tmp_path / 'run'}", *more,
    ]  # fmt: skip
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True)


def test_kept_timings_stand_where_models_are_not_here(tmp_path, caplog):
    """Results travel as text, models do not: their timings must not be replaced by those of a few."""
    kept = {"gp": {"p50_ms": 1.5, "p95_ms": 2.0, "to_copy": 0.5, "rounds": 60}}
    (tmp_path / "latency-toy.json").write_text(json.dumps(kept))
    cells = [Filled(Cell("toy", "random", "gp", None, None), tmp_path / "gp", {})]
    assert timed_here(cells, {}, tmp_path, measure=True)["toy"]["gp"].p50_ms == 1.5
    assert "models of gp are not here" in caplog.text
    assert timed_here(cells, {}, tmp_path / "none", measure=True) == {"toy": {}}


def test_what_is_only_timed_is_a_page_too(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(command, "show", lambda *given: shown.append(given))
    facts = {"dataset/kind": "spectrum"}
    cell = Filled(Cell("toy", "random", "nerf2_published", None, None), tmp_path, facts)
    command.report([cell], {"toy": {"nerf2_published": Latency(6e4, 6e4, 1.0, 1)}}, "gsparc", tmp_path)
    assert "nerf2_published on toy: 60 s a query, timed only" in (tmp_path / "compare.md").read_text()
    assert len((tmp_path / "compare.csv").read_text().splitlines()) == 1 and shown


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
    assert prepared.found() is None and prepared.found_earlier() is None
    write("toy-random-gp-old", made="2026-01-01")
    write("toy-random-gp-newer", made="2026-01-02", git="abcdefghijk")
    found = prepared.found_earlier()
    assert found.earlier == "abcdefgh" and found.folder.name == "toy-random-gp-newer"
    write("toy-random-gp-today")
    assert prepared.found().earlier is None
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


@pytest.mark.parametrize("model", ["gsparc", "moving_array"])
def test_the_trainers_budget_is_part_of_the_name_of_whoever_takes_it(model, tmp_path):
    """A model was trained as if there were no budget: one of 5 s was found again as one of 60 s."""
    problem = Problem("own", "random", "spectrum", ("d", "s", "i"))
    contender = Contender(model, (f"model={model}",), ("budget_s={budget_s}",))
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        short, long = (
            prepare(Cell("own", "random", model, budget_s, 0), contender, {"file": "x"}, problem, tmp_path)
            for budget_s in (5.0, 60.0)
        )
    assert short.config.budget_s == 5 and short.folder != long.folder


@pytest.mark.parametrize("model", ["gsparc", "moving_array"])
def test_every_seed_is_a_cell_of_its_own(model, tmp_path):
    """The first seed of gsparc stood for all three: a spread of 0.00."""
    problem = Problem("own", "random", "spectrum", ("d", "s", "i"))
    contender = Contender(model, (f"model={model}",), ("budget_s={budget_s}",))
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        folders = [
            prepare(
                Cell("own", "random", model, 60.0, seed), contender, {"file": "x"}, problem, tmp_path
            ).folder
            for seed in range(3)
        ]
    assert len(set(folders)) == 3


@pytest.mark.parametrize(
    ("settings", "choose"),
    [({"batch_size": 4}, ()), ({}, ("budget_clock=processor",)), ({}, ("init_from=model.ckpt",))],
)
def test_a_cell_was_taken_for_one_of_another_batch_clock_or_start(settings, choose, tmp_path):
    """These settings stand beside the model's: a table of batches of 4 showed cells of batches of 16."""
    cell = Cell("own", "random", "gsparc", 5.0, 0)
    problem = Problem("own", "random", "spectrum", ("d", "s", "i"))
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        folders = []
        for own, more in (({}, ()), (settings, choose)):
            contender = Contender("gsparc", ("model=gsparc", *more), ("budget_s={budget_s}",))
            folders.append(prepare(cell, contender, {"file": "x", **own}, problem, tmp_path).folder)
    assert folders[0] != folders[1]


def test_a_cell_was_taken_for_one_of_other_walls_in_a_file_of_that_name(tmp_path):
    cell, walls = Cell("own", "random", "gsparc", 5.0, 0), tmp_path / "walls.json"
    problem = Problem("own", "random", "rssi", ("d", "s", "i"))
    contender = Contender("gsparc", ("model=gsparc", "init=scene", f"init.file={walls}"), ("budget_s=5",))
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        folders = []
        for text in ("[]", "[1]"):
            walls.write_text(text)
            folders.append(prepare(cell, contender, {"file": "x"}, problem, tmp_path).folder)
    assert folders[0] != folders[1]


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


@pytest.mark.slow
def test_cells_are_filled_once_and_reported_again(tmp_path):
    spectra(tmp_path / "own.npz")
    only = "only=[own/random/mean/*,own/random/nearest/*,own/random/swiftwrf/*]"
    first = compare(tmp_path, only)
    assert first.returncode == 0, first.stderr
    assert "3 cells, 0 of them are there" in first.stdout and len(FILLED.findall(first.stdout)) == 3
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["own/random/0.3/first"] in ("nearest", "mean", "swiftwrf")
    assert summary["own/random/0.3/swiftwrf/query_ms_p50"] > 0
    for file in ("compare.csv", "compare.md", "compare.png"):
        assert (tmp_path / "run" / file).exists()
    again = compare(tmp_path, only, "latency=false")
    assert "3 cells, 3 of them are there" in again.stdout
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == summary
    with held(tmp_path / "cells"):
        other = compare(tmp_path, only, f"hydra.run.dir={tmp_path / 'other'}")
    assert other.returncode == 1 and "another run writes here; wait for its end" in other.stderr
    assert "give another cells=" in other.stderr and not (tmp_path / "other" / "compare.md").exists()
    absent = compare(tmp_path, only, "datasets.own.file=null", "train=false")
    assert absent.returncode == 0 and "here as far as results were kept" in absent.stdout + absent.stderr
    assert "3 cells, 3 of them are there" in absent.stdout
    # A cell whose result is not whole does not count.
    (cell,) = (tmp_path / "cells").glob("own-random-mean-*/cell.json")
    cell.write_text("{")
    assert "3 cells, 2 of them are there" in compare(tmp_path, only, "latency=false").stdout


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["joblib", "ray"])
def test_cells_filled_elsewhere_are_the_same(tmp_path, engine):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    spectra(tmp_path / "own.npz")
    only, found = "only=[own/random/mean/*,own/random/nearest/*,own/random/gp/*,own/random/idw/*]", []
    for cells, chosen in (("one", "process"), ("two", engine)):
        done = compare(tmp_path, only, "latency=false", f"engine={chosen}", f"cells={tmp_path / cells}")
        assert done.returncode == 0 and len(FILLED.findall(done.stdout)) == 4, done.stderr
        files = sorted((tmp_path / cells).glob("*/cell.json"))
        facts = [json.loads(file.read_text()) for file in files]
        found.append([{k: v for k, v in one.items() if k.startswith("test/")} for one in facts])
    assert found[0] == found[1] and len(found[0]) == 4 and min(map(len, found[0])) > 1


@pytest.mark.slow
def test_mistakes_are_one_line(tmp_path):
    spectra(tmp_path / "own.npz")
    done = compare(tmp_path, "only=[own/random/meen/*]")
    assert done.returncode == 1 and "matches no cell" in done.stderr and "Traceback" not in done.stderr
    done = compare(tmp_path, "train=false", "only=[own/random/mean/*]")
    assert done.returncode == 1 and "no cell is filled" in done.stderr


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
