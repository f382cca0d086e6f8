"""Splits as JSON index files, which a run writes as split.json and `split=file` reads."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError, readable
from gsparc.base.files import write_whole
from gsparc.data.splits import Fold, Split

log = logging.getLogger(__name__)


def write_split(
    path: str | Path, split: Split, rows: int, dataset_sha256: str = "", run_id: str | None = None
) -> None:
    """Store a split of `rows` rows as a JSON index file (atomically), with the run that made it."""
    facts = {"schema": 1, "name": split.name, "rows": rows, "dataset_sha256": dataset_sha256}
    facts |= {} if run_id is None else {"run_id": run_id}
    folds = [{name: part.tolist() for name, part in vars(fold).items()} for fold in split.folds]
    content = {**facts, "sha256": split.sha256, "folds": folds}
    write_whole(path, json.dumps(content) + "\n")


def read_split(path: str | Path, rows: int, dataset_sha256: str = "") -> Split:
    """Read an index file for a dataset of `rows` rows; warns when it was made for other data.

    Raises:
        DataError: not an index file, made for another number of rows, edited, or with overlapping
            parts.
    """
    path = Path(path)
    # Whatever a damaged or foreign JSON file raises: deep brackets, huge numbers, other types.
    errors = (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError)
    with readable(
        path, "not a split file", errors, "no such split file; a run writes one as split.json"
    ):
        content = json.loads(path.read_text(encoding="utf-8"))
        folds = tuple(
            Fold(*(np.array(f[k], dtype=np.int64).reshape(-1) for k in ("train", "val", "test")))
            for f in content["folds"]
        )
        name, stored_rows, stored_hash = (
            str(content["name"]),
            int(content["rows"]),
            str(content["sha256"]),
        )
    if stored_rows != rows:
        raise DataError(f"{path}: made for {stored_rows} rows, the dataset has {rows}")
    for i, fold in enumerate(folds):
        rows_of_fold = np.concatenate([fold.train, fold.val, fold.test])
        if len(np.unique(rows_of_fold)) != len(rows_of_fold):
            raise DataError(
                f"{path}: fold {i} names a row twice (train, val and test must be disjoint)"
            )
        if len(rows_of_fold) and (rows_of_fold.min() < 0 or rows_of_fold.max() >= rows):
            raise DataError(f"{path}: fold {i} names a row outside 0 to {rows - 1}")
    split = Split(name, folds)
    if not folds or split.sha256 != stored_hash:
        raise DataError(
            f"{path}: the indices do not match their sha256; the file was edited or damaged"
        )
    if dataset_sha256 and content.get("dataset_sha256") not in ("", None, dataset_sha256):
        log.warning(
            "%s was made for other data (their content hashes differ); rows may not correspond",
            path,
        )
    return split
