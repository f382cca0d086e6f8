"""The command: fills what is missing, finds what is there, goes on after a failure."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import spectra

from gsparc.commands import compare as command
from gsparc.commands.run_lock import locked
from gsparc.evaluation.experiment.cells import Cell
from gsparc.evaluation.experiment.fitting import Filled
from gsparc.evaluation.experiment.latency import Latency

ROOT = Path(__file__).parents[2]
FILLED = re.compile(r"own/\S+: \S+ dB after ")  # a line of each cell


def compare(tmp_path, *more: str) -> subprocess.CompletedProcess:
    words = [
        sys.executable, "-m", "gsparc", "compare", f"+datasets.own.file={tmp_path / 'own.npz'}",
        "splits.random.datasets=[own]", "budgets=[{seconds: 0.3, seeds: [0]}]", f"cells={tmp_path / 'cells'}",
        f"hydra.run.dir={tmp_path / 'run'}", *more,
    ]  # fmt: skip
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True)


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
    with locked(tmp_path / "cells"):
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
