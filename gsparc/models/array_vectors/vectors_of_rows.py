"""Retrieved array vectors of the rows of a dataset, and their report."""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.models.array_vectors.phase_retrieval import Recovered, recover
from gsparc.models.target_rows import training_targets

log = logging.getLogger(__name__)

AT_ONCE = 1024  # rows solved together, which bounds the memory
NAMED = 8  # suspect images named in a log line


def recovered(data: Measurements, rows: np.ndarray, seed: int = 0) -> Recovered:
    """Return array vectors of the given rows; no others are read.

    Args:
        data: spectra of a static array.
        rows: (n,) sorted.
        seed: of the random starts.
    """
    blocks = np.array_split(rows, -(-len(rows) // AT_ONCE))
    parts = [recover(data.site, training_targets(data, part), data.tx[part], seed) for part in blocks]
    return Recovered(**{name: np.concatenate([vars(one)[name] for one in parts]) for name in vars(parts[0])})


def report(result: Recovered, data: Measurements, rows: np.ndarray, path: Path) -> None:
    """Write the residual of each image as CSV and log the suspect ones."""
    names = data.row_names or [f"row {i}" for i in range(len(data))]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["row", "name", "residual", "outside_the_array", "quantisation", "suspect"])
        for i, row in enumerate(rows):
            figures = (result.residual[i], result.floor[i], result.expected[i])
            writer.writerow([row, names[row], *(f"{v:.3e}" for v in figures), int(result.suspect[i])])
    bad = rows[result.suspect]
    log.info(
        "array vectors of %d spectra: median residual %.1e, quantisation %.1e",
        len(rows), np.median(result.residual), np.median(result.expected),
    )  # fmt: skip
    if len(bad):
        more = f" and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
        log.warning(
            "%d spectra do not fit this array (see %s): %s%s",
            len(bad), path.name, ", ".join(names[i] for i in bad[:NAMED]), more,
        )  # fmt: skip
