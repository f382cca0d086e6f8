"""Retrieved array vectors of a dataset, each solved once in a process, and their report."""

from __future__ import annotations

import csv
import logging
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import list_first
from gsparc.data.assemble import identity_hash
from gsparc.data.schema import Measurements
from gsparc.models.array_vectors.phase_retrieval import RecoveredVectors, recover_vectors
from gsparc.models.target_rows import training_targets
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

AT_ONCE = 1024  # rows solved together, which bounds the memory


@lru_cache(maxsize=1)
def _solved_rows(key: str) -> dict[int, tuple[tuple[Any, ...], float, Stopwatch]]:
    """By row of the data last asked for its parts of `RecoveredVectors`, their seconds,
    and who paid last.
    """
    return {}


forget_vectors = _solved_rows.cache_clear  # before what is to pay for its own work


def recover_cached(
    data: Measurements, rows: np.ndarray, seed: int = 0, watch: Stopwatch | None = None
) -> RecoveredVectors:
    """Return array vectors of the given rows.

    Only these rows are read: vectors of a test set are never computed for a training run. Rows that
    this process has solved for the same data, as a refit's are, are not solved again.

    Args:
        data: spectra of a static array.
        rows: (n,) sorted.
        seed: of the random starts.
        watch: of the fit, which is charged for rows that another fit has solved.
    """
    watch = watch or Stopwatch()
    cache = _solved_rows(f"{identity_hash(data)} {seed}")
    names = [setting_field.name for setting_field in fields(RecoveredVectors)]
    missing = np.array([row for row in rows.tolist() if row not in cache], np.int64)
    unpaid = [row for row in rows.tolist() if row in cache and cache[row][2] is not watch]
    if unpaid:
        more = sum(cache[row][1] for row in unpaid)
        message = (
            "array vectors of %d spectra were computed before, by a fit whose %.2f s count "
            "here, too"
        )
        log.info(message, len(unpaid), more)
        watch.charge(more)
        cache.update((row, (*cache[row][:2], watch)) for row in unpaid)
    for part in np.array_split(missing, -(-len(missing) // AT_ONCE)) if len(missing) else ():
        began = watch.seconds
        recovery = recover_vectors(data.site, training_targets(data, part), data.tx[part], seed)
        parts = zip(*(getattr(recovery, name) for name in names), strict=True)
        each = (watch.seconds - began) / len(part)
        cache.update(
            (row, (vector, each, watch)) for row, vector in zip(part.tolist(), parts, strict=True)
        )
    return RecoveredVectors(
        *map(np.stack, zip(*(cache[row][0] for row in rows.tolist()), strict=True))
    )


def write_recovery_report(
    result: RecoveredVectors, data: Measurements, rows: np.ndarray, path: Path
) -> None:
    """Write the residual of each image as CSV and log the suspect ones."""
    names = data.row_names or [f"row {i}" for i in range(len(data))]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["row", "name", "residual", "outside_the_array", "quantisation", "suspect"])
        for i, row in enumerate(rows):
            figures = (result.residual[i], result.floor[i], result.expected[i])
            writer.writerow(
                [row, names[row], *(f"{v:.3e}" for v in figures), int(result.is_suspect[i])]
            )
    bad = rows[result.is_suspect]
    log.info(
        "array vectors of %d spectra: median residual %.1e, quantisation %.1e",
        len(rows),
        np.median(result.residual),
        np.median(result.expected),
    )
    if len(bad):
        called, them = ("spectrum", "it") if len(bad) == 1 else ("spectra", "them")
        log.warning(
            "%d %s cannot come from this array: %s; used all the same, check %s and "
            "array_position, "
            "%s has the figures",
            len(bad),
            called,
            list_first([names[i] for i in bad]),
            them,
            path.name,
        )
