"""Which rows train, validate and test; stored as index files with a hash."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fold:
    """Disjoint row indices; `val` is for choosing and calibrating, never for reporting.

    Attributes:
        train, val, test: (n,) int64, sorted.
    """

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray


@dataclass(frozen=True)
class Split:
    """One fold, or several whose test results are pooled.

    Attributes:
        name: `random`, `grouped`, `block`, `sparse` or a file's name.
        folds: one or more folds.
        sha256: hash of all indices.
    """

    name: str
    folds: tuple[Fold, ...]
    sha256: str
