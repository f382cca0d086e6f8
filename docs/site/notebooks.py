"""Run the tutorials, each in a folder of its own: `python docs/site/notebooks.py [NAME ...]`."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
# pages.py takes the notebooks from here where they are
DONE = ROOT / "build" / "executed" / "tutorials"
LIMIT_S = 900  # of a cell by the clock, which a busy machine stretches

log = logging.getLogger(__name__)


def run(file: Path) -> float:
    """Seconds that a notebook took; it is written to `DONE` with what it showed.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(file, nbformat.NO_CONVERT)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        where = {"metadata": {"path": folder}}
        client = NotebookClient(
            notebook, timeout=LIMIT_S, kernel_name="python3", resources=where, coalesce_streams=True
        )
        client.execute()
    seconds = time.perf_counter() - began
    DONE.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, DONE / file.name)
    return seconds


def main(names: list[str]) -> float:
    """Run the named tutorials, or all; returns the seconds in all."""
    found = [
        f
        for f in sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
        if not names or f.stem in names
    ]
    total = 0.0
    for file in found:
        seconds = run(file)
        total += seconds
        log.info("%s: %.0f s", file.stem, seconds)
    log.info("%d notebooks: %.0f s", len(found), total)
    return total


if __name__ == "__main__":
    # Of `gsparc` in cells
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(sys.argv[1:])
