"""Initialisers of conditional fields for channels: sources searched for, measured rays, none at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.conditional import CompletedField, ConditionalField
from gsparc.field.initial import InitSettings
from gsparc.methods.method import FitContext, FitReport
from gsparc.multipath.directional_gp import DirectionalGP
from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.multipath.source_field import RayField, SourceField


def sources(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Image sources of several searches."""
    method = ImageSourceGP(
        searches=init.searches, search_rows=init.search_rows, rows=init.rows, margin=init.margin,
        max_sources=init.max_sources, order=init.order, clutter=clutter, edges=init.edges, seed=context.seed,
    )  # fmt: skip
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return SourceField(method), report


def rays(
    data: Measurements, rows: np.ndarray, init: InitSettings, clutter: bool, context: FitContext
) -> tuple[ConditionalField, FitReport]:
    """Sources where measured directions meet."""
    method = DirectionalGP(rows=init.rows, seed=context.seed)
    report = method.fit(data, Fold(rows, rows[:0], rows[:0]), context)
    return RayField(method), report
