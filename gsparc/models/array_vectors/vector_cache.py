"""Cache of retrieved array vectors on disk, by dataset: a sweep solves each spectrum once."""

from __future__ import annotations

import csv
import logging
from dataclasses import fields
from pathlib import Path

import numpy as np

from gsparc.data.assemble import identity
from gsparc.data.files import whole_file
from gsparc.data.schema import Measurements
from gsparc.models.array_vectors.phase_retrieval import Recovered, recover
from gsparc.models.target_rows import training_targets
from gsparc.training.time_budget import Spent, TimeBudget

log = logging.getLogger(__name__)

AT_ONCE = 1024  # rows solved between two writes
VERSION = 3  # raise it when phase retrieval changes its results
NAMED = 8  # suspect images named in a log line


def recovered(
    data: Measurements, rows: np.ndarray, cache: Path | None, seed: int = 0
) -> tuple[Recovered, Spent]:
    """Array vectors of the given rows, cached where known, and the seconds they took when computed.

    Only these rows are read: vectors of a test set are never computed for a training run. The cache is
    written after every `AT_ONCE` rows, so that an interrupted run continues there.

    Args:
        data: spectra of a static array.
        rows: (n,) sorted.
        cache: folder; None for no cache.
        seed: of the random starts.
    """
    path = None if cache is None else Path(cache) / f"array-v{VERSION}" / f"{identity(data)[:24]}.npz"
    known = _read(path, len(data))
    have = np.zeros(len(data), dtype=bool) if known is None else known["wall"] >= 0
    missing = rows[~have[rows]]
    if known is not None and have[rows].any():
        log.info(
            "array vectors of %d spectra are cached: training time includes the %.1f s they took to compute",
            have[rows].sum(), known["wall"][rows][have[rows]].sum(),
        )  # fmt: skip
    for part in np.array_split(missing, -(-len(missing) // AT_ONCE)) if len(missing) else ():
        watch = TimeBudget()
        recovery = recover(data.site, training_targets(data, part), data.tx[part], seed)
        spent = vars(watch.counted)
        known = known or _empty(len(data), recovery)
        for name, values in known.items():
            values[part] = spent[name] / len(part) if name in spent else getattr(recovery, name)
        if path is not None:
            _write(path, known)
    assert known is not None
    result = Recovered(**{f.name: known[f.name][rows] for f in fields(Recovered)})
    return result, Spent(*(float(known[f.name][rows].sum()) for f in fields(Spent)))


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


def _empty(count: int, like: Recovered) -> dict[str, np.ndarray]:
    arrays = {f.name: getattr(like, f.name) for f in fields(Recovered)}
    return {
        **{k: np.zeros((count, *v.shape[1:]), dtype=v.dtype) for k, v in arrays.items()},
        **{f.name: np.full(count, -1.0) for f in fields(Spent)},
    }


def _read(path: Path | None, count: int) -> dict[str, np.ndarray] | None:
    if path is None or not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            known = {f.name: file[f.name] for f in (*fields(Recovered), *fields(Spent))}
    except Exception as error:  # whatever a damaged archive raises: it is only a cache
        log.warning("cached array vectors are not readable and are computed anew: %s (%s)", path, error)
        return None
    return known if all(len(values) == count for values in known.values()) else None


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
