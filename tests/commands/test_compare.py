"""The command: fills what is missing, finds what is there, goes on after a failure."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import spectra
from doors import knock

from gsparc.commands import compare as command
from gsparc.commands.listing import COMMANDS
from gsparc.commands.shared.run_lock import locked
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled
from gsparc.evaluation.experiment.latency import Latency

ROOT = Path(__file__).parents[2]
FILLED = re.compile(r"own/\S+: \S+ dB after ")  # a line of each cell


def words(tmp_path, *more: str) -> list[str]:
    return [
        f"+datasets.own.file={tmp_path / 'own.npz'}", "splits.random.datasets=[own]", "threads=1",
        "budgets=[{seconds: 0.3, seeds: [0]}]", f"cells={tmp_path / 'cells'}",
        f"hydra.run.dir={tmp_path / 'run'}", *more,
    ]  # fmt: skip


def compare(tmp_path, *more: str) -> tuple[int, str]:
    """Exit status, and what is said."""
    answer = knock(COMMANDS["compare"].run, "compare", words(tmp_path, *more))
    return answer.status, "\n".join([*answer.out, *answer.err])


def test_what_is_only_timed_is_a_page_too(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(command, "show", lambda *given: shown.append(given))
    facts = {"dataset/kind": "spectrum"}
    cell = Filled(Cell("toy", "random", "nerf2_published", None, None), tmp_path, facts)
    command.report([cell], {"toy": {"nerf2_published": Latency(6e4, 6e4, 1.0, 1)}}, "gsparc", tmp_path)
    assert "nerf2_published on toy: 60 s a query, timed only" in (tmp_path / "compare.md").read_text()
    assert len((tmp_path / "compare.csv").read_text().splitlines()) == 1 and shown


@pytest.mark.slow
def test_cells_are_filled_once_and_reported_again(tmp_path):
    spectra(tmp_path / "own.npz")
    only = "only=[own/random/mean/*,own/random/nearest/*,own/random/swiftwrf/*]"
    status, said = compare(tmp_path, only)
    assert status == 0, said
    assert "3 cells, 0 of them are there" in said and len(FILLED.findall(said)) == 3
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["own/random/0.3/first"] in ("nearest", "mean", "swiftwrf")
    assert summary["own/random/0.3/swiftwrf/query_ms_p50"] > 0
    for file in ("compare.csv", "compare.md", "compare.png"):
        assert (tmp_path / "run" / file).exists()
    assert "3 cells, 3 of them are there" in compare(tmp_path, only, "latency=false")[1]
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == summary
    with locked(tmp_path / "cells"):
        status, said = compare(tmp_path, only, f"hydra.run.dir={tmp_path / 'other'}")
    assert status == 1 and "another run writes here; wait for its end" in said
    assert "give another cells=" in said and not (tmp_path / "other" / "compare.md").exists()
    status, said = compare(tmp_path, only, "datasets.own.file=null", "train=false")
    assert status == 0 and "here as far as results were kept" in said
    assert "3 cells, 3 of them are there" in said
    # A cell whose result is not whole does not count.
    (cell,) = (tmp_path / "cells").glob("own-random-mean-*/cell.json")
    cell.write_text("{")
    assert "3 cells, 2 of them are there" in compare(tmp_path, only, "latency=false")[1]


PLAIN = "only=[own/random/nearest/*,own/random/gp/*]", "latency=false"


def figures(folder) -> list[dict]:
    facts = [json.loads(file.read_text()) for file in sorted((folder / "cells").glob("*/cell.json"))]
    return [{key: value for key, value in one.items() if key.startswith("test/")} for one in facts]


@pytest.fixture(scope="module")
def filled_here(tmp_path_factory) -> list[dict]:
    """Figures of two cells that this process filled."""
    folder = tmp_path_factory.mktemp("here")
    spectra(folder / "own.npz")
    status, said = compare(folder, *PLAIN)
    assert status == 0 and len(FILLED.findall(said)) == 2, said
    return figures(folder)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["joblib", "ray"])
def test_cells_filled_elsewhere_are_the_same(filled_here, tmp_path, engine):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    spectra(tmp_path / "own.npz")
    command = [sys.executable, "-m", "gsparc", "compare", *words(tmp_path, *PLAIN, f"engine={engine}")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and len(FILLED.findall(done.stdout)) == 2, done.stderr
    assert figures(tmp_path) == filled_here and min(map(len, filled_here)) > 1
