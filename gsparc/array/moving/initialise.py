"""Initialiser of conditional fields for spectra of a moving array."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.array.moving.bearing_field import BearingField
from gsparc.array.moving.method import MovingArrayField
from gsparc.array.moving.triangulate import SearchSettings
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.conditional import ConditionalField
from gsparc.field.initial import InitSettings
from gsparc.methods.censored import heard
from gsparc.methods.method import FitContext, FitReport


def bearings(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Sources where bearings cross, of at most `init.searches` searches.

    With seconds in the context, searches end when the left-out error no longer falls; without, one is made.
    Of `init`, `searches` and `max_sources` are heeded; `clutter` means nothing to spectra.

    Raises:
        ValueError: not spectra of a moving receiver with a declared array that keeps its orientation.
    """
    search = replace(SearchSettings(), sources=init.max_sources)
    method = MovingArrayField(search=search, seed=context.seed, most_searches=init.searches)
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return BearingField(method, heard(data, rows)), report
