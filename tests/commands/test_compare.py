"""The command: fills what is missing, finds what is there, goes on after a failure."""

import json
import re
from concurrent.futures import ThreadPoolExecutor

import pytest
from campaigns import spectra
from doors import knock
from pages import compare_files

from gsparc.commands.listing import COMMANDS
from gsparc.runs.run_lock import locked

FILLED = re.compile(r"own/\S+: \S+ \S+ after ")  # a line of each cell


def words(tmp_path, *more: str) -> list[str]:
    return [
        f"+datasets.own.file={tmp_path / 'own.npz'}",
        "splits.random.datasets=[own]",
        "threads=1",
        "efforts=[0.005]",
        f"cells={tmp_path / 'cells'}",
        f"hydra.run.dir={tmp_path / 'run'}",
        *more,
    ]


def compare(tmp_path, *more: str) -> tuple[int, str]:
    """Exit status, and what is said."""
    answer = knock(COMMANDS["compare"].run, "compare", words(tmp_path, *more))
    return answer.status, "\n".join([*answer.out, *answer.err])


@pytest.mark.slow
def test_a_comparison_left_files_that_its_page_did_not_name(tmp_path):
    """The page said compare.png where there is one picture a dataset, and not cells.csv."""
    spectra(tmp_path / "own.npz")
    drawn = ["splits.drawn.datasets=[own]", "splits.drawn.draws=2", "latency=false"]
    for only, picture in (("random", "compare.png"), ("drawn", "own.png")):
        run = tmp_path / only
        status, said = compare(
            tmp_path, f"only=[own/{only}/mean/*]", *drawn, f"hydra.run.dir={run}"
        )
        assert status == 0 and (run / picture).exists(), said
        assert compare_files("compare", run) == ([], [])
    cell = tmp_path / "cells/own/random/mean/any/any"
    assert compare_files("train", cell)[0] == []


@pytest.mark.slow
def test_cells_are_filled_once_and_reported_again(tmp_path):
    spectra(tmp_path / "own.npz")
    only = "only=[own/random/mean/*,own/random/nearest/*,own/random/swiftwrf/*]"
    status, said = compare(tmp_path, only, "figures=[svg]")
    assert status == 0, said
    assert "3 cells, 0 already done" in said and len(FILLED.findall(said)) == 3
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    (first,) = (value for name, value in summary.items() if name.endswith("/first"))
    table = (tmp_path / "run" / "compare.csv").read_text()
    assert first in ("nearest", "mean", "swiftwrf") and "own,random,0.005,swiftwrf" in table
    for file in ("compare.csv", "compare.md", "compare.png", "compare.svg"):
        assert (tmp_path / "run" / file).exists()
    assert "3 cells, 3 already done" in compare(tmp_path, only, "latency=false")[1]
    again = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert again == summary
    with locked(tmp_path / "cells"), ThreadPoolExecutor(1) as other:  # the same one may go on
        asked = other.submit(compare, tmp_path, only, f"hydra.run.dir={tmp_path / 'other'}")
        status, said = asked.result()
    assert status == 1 and "another run writes here" in said and "wait for its end" in said
    assert "give another cells=" in said and not (tmp_path / "other" / "compare.md").exists()
    # A cell whose result is not whole does not count,
    # nor does one of other data under the same name.
    (tmp_path / "cells/own/random/mean/any/any/summary.json").write_text("{")
    assert "3 cells, 2 already done" in compare(tmp_path, only, "latency=false")[1]
    spectra(tmp_path / "own.npz", rows=44)
    assert "3 cells, 0 already done" in compare(tmp_path, only, "latency=false", "train=false")[1]
