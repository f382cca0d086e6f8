"""Whether several stations are learned in one field or each in its own, where nobody says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gsparc.data.inner_folds import cut_folds
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import LEAST_ROWS, Fold
from gsparc.field.initial import InitSettings
from gsparc.models.method import Method, MethodFactory
from gsparc.models.per_station import station_site
from gsparc.models.powers.field import PowerField
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.network import find_sectors
from gsparc.models.target_rows import decibels, heard_rows
from gsparc.processes.term import Columns
from gsparc.training.context import FitContext

ONE_FACTOR = 6_000  # rows: a covariance of more is not factored as one


class LearnsTogether(MethodFactory):
    """Learns several stations of a site in one field, or each in its own."""

    both_ends = True
    takes_budget = True
    init: InitSettings
    own_terms: tuple[Columns, ...] = ()  # of one station's powers

    def learns_jointly(self, site: Site) -> bool:
        """Tell whether stations share a field: of powers, or channels of a known carrier with phases."""
        waves = site.kind == "csi" and site.wavelength is not None and site.static_end is not None
        return (waves and site.phase_reference != "neighbours") or site.kind == "rssi"

    def choose_stations(
        self, data: Measurements, fold: Fold, context: FitContext
    ) -> tuple[Literal["each", "together"], str]:
        """See `Method.choose_stations`."""
        if self.own_terms:
            return "each", "model.terms are of one station"
        if not self.learns_jointly(data.site) or self.init.name == "scene":
            return "each", ""
        return choose_stations(data, fold, context)


def choose_stations(
    data: Measurements, fold: Fold, context: FitContext
) -> tuple[Literal["each", "together"], str]:
    """Return how stations of a site that can be learned as one are best learned, and why.

    Channels share waves and where their stations really stand: together. Powers share little more than a
    law, so that folds cut as the test was cut decide, between processes without Gaussians.
    """
    assert data.station is not None
    if data.site.kind == "csi":
        return "together", "channels at all stations share waves and the frame of places"
    if find_sectors(data) is not None:
        return "together", "sectors of a network share a law, a pattern and the shadowing of their sites"
    if not np.isin(data.station[fold.test], data.station[fold.train]).any() and len(fold.test):
        return "together", "no station of the test rows was heard, and what stations share answers for them"
    known = heard_rows(data, np.sort(np.concatenate([fold.train, fold.val])))
    if len(known) > ONE_FACTOR:
        return "each", f"{len(known)} rows are more than one factor holds ({ONE_FACTOR})"
    budget = context.time_budget()
    errors, folds, most = [], budget.effort.station_folds, budget.effort.station_rows
    # Two folds at least are cut, though one may be looked at: a single one would test all rows.
    for inner in cut_folds(data, fold, context.split, max(folds, 2), context.seed).folds[:folds]:
        learned = heard_rows(data, np.union1d(inner.train, inner.val))
        # Rows below or above a level have no value to be wrong by.
        queries = inner.test[data.censored_side(inner.test) == 0]
        if len(learned) > most:
            # Drawn from all stations at once: each keeps its share of the rows.
            learned = np.sort(np.random.default_rng(context.seed).permutation(learned)[:most])
        # Trial fits leave no files, and go on from none.
        own = replace(context, run_dir=Path(), resume=None, budget_s=budget.left_s)
        parts = list(_predict_by_station(data, learned, queries, own))
        if not parts:
            continue
        joint = JointPowerField(shared=False, seed=context.seed)
        joint.fit(data, Fold(learned, learned[:0], learned[:0]), own)
        rows = np.concatenate([part for part, _ in parts])
        separate = torch.cat([powers for _, powers in parts])
        target = decibels(data.batch(rows).target.flatten().double())
        errors.append([(_decibels(joint, data, rows) - target).square(), (separate - target).square()])
        if budget.is_spent():
            break
    if not errors:
        return "together", "too few rows of each station to leave any out"
    # Over rows of all folds, which differ in size.
    together, each = (float(torch.cat(part).mean().sqrt()) for part in zip(*errors, strict=True))
    why = f"rmse {together:.2f} dB together, {each:.2f} dB each, of rows left out as the test is"
    return ("together" if together <= each else "each"), f"{why} ({len(errors)} folds)"


def _predict_by_station(
    data: Measurements, learned: np.ndarray, queries: np.ndarray, context: FitContext
) -> Iterator[tuple[np.ndarray, Tensor]]:
    """Rows (m,) asked of each station with rows to learn from, and powers (m,) [dB] by its own process."""
    assert data.station is not None
    for number in np.unique(data.station[queries]).tolist():
        rows = np.flatnonzero(data.station == number)
        known, left = (np.flatnonzero(np.isin(rows, part)) for part in (learned, queries))
        if len(known) >= LEAST_ROWS:
            part = data.subset(rows, station_site(data.site, number))
            single = PowerField(waves=False, seed=context.seed)
            single.fit(part, Fold(known, known[:0], known[:0]), context)
            yield rows[left], _decibels(single, part, left)


@torch.no_grad()
def _decibels(method: Method, data: Measurements, rows: np.ndarray) -> Tensor:
    return decibels(method.predict(data.batch(rows)).mean.flatten().double())
