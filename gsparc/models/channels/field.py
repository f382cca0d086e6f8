"""Channels of one static end or several as a Gaussian process of waves,
conditioned on measured rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.ends import Ends
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.models.channels.columns import (
    Group,
    Slot,
    SlotPlaces,
    fit_run_factors,
    group_channels,
)
from gsparc.models.channels.common import SharedGains
from gsparc.models.channels.initial import ChannelSettings, find_terms
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Direct, Images
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.run_factors import RunFactors
from gsparc.ops.transforms import to_numpy
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.density import TINY
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import evenly_spaced
from gsparc.processes.left_out import ENTRIES
from gsparc.processes.stored import from_plain, to_plain
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

ROUNDED = 1e-3  # of the noise, error of variances below which half the digits do
CHECKED = 64  # rows that this is tried at


@dataclass(frozen=True)
class GroupWeights:
    """A group's rows, and what its predictions are made of.

    Attributes:
        group: with targets in the phase and level of the largest run.
        given: the targets given their covariance (n, n) complex128.
        scale: power that the covariance is in units of.
        noise: least variance of a prediction, in these units.
        is_real: whether the covariance is.
    """

    group: Group
    given: Conditioned
    scale: float
    noise: float
    is_real: bool

    @cached_property
    def root(self) -> Tensor:
        """(n, n), inverse of `lower`: real where that is,
        in single precision where variances allow it.

        A row's covariances c with all rows, its noise included, have c^H C^-1 c = C_ii:
        that tells the error.
        """
        whole = self.given.factor.lower
        lower = whole.real.contiguous() if self.is_real else whole
        root = Factor(lower).root
        few = lower[evenly_spaced(len(lower), CHECKED)]
        # A query reads all n^2 entries of the root, of which single precision has half the bytes.
        short = root.to(torch.float32 if self.is_real else torch.complex64)
        squares = ((few @ lower.mH).to(short.dtype) @ short.mH).abs().square().sum(1)
        error = (squares - few.abs().square().sum(1)).abs().max()
        return short if float(error) <= ROUNDED * self.noise else root

    def explained_variance(self, cross: Tensor) -> Tensor:
        """Return the variance (m,) that the rows take away from places of covariances (m, n)
        with them.
        """
        cross = (cross.real if self.is_real else cross).to(self.root.dtype)
        return (cross.conj() @ self.root.T).abs().square().sum(1)


class ChannelField(ClosedForm):
    """Leakage, direct wave, images and a diffuse field of a static end and one that moves.

    Args:
        settings: terms that are tried.
    """

    name = "waves"
    site: Site
    prior: ChannelPrior
    channel: tuple[int, int]  # (A, K) of the targets

    def __init__(self, settings: ChannelSettings | None = None) -> None:
        self.settings = settings or ChannelSettings()
        self.weights: tuple[GroupWeights, ...] = ()
        self.stations: dict[int, list[GroupWeights]] = {}
        self.common: SharedGains | None = None
        self.rows = np.zeros(0, np.int64)
        self.runs = RunFactors.identity()

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose terms and their powers from training and validation rows, and condition on these.

        Raises:
            ValueError: the data are no channels of a known carrier with one static end.
        """
        watch, rows = Stopwatch(), fold.learned()
        self.site, self.channel = data.site, (int(data.target.shape[1]), int(data.target.shape[2]))
        self.prior, notes = find_terms(data, rows, self.settings, context.counts)
        self.condition(data, rows)
        return FitReport(watch.seconds, notes)

    @property
    def by_antenna(self) -> bool:
        """Whether antennas and tones have covariances of their own."""
        return self.prior.find_term(Direct) is not None or self.count_components() > 0

    def count_components(self) -> int:
        """Return the number of images."""
        images = self.prior.find_term(Images)
        return 0 if images is None else len(images.planes)

    @property
    def terms(self) -> tuple[str, ...]:
        """Of `residual` (diffuse field), `directions`, `leakage`, `direct`, `mirrors`, `drift`."""
        return tuple(term.name for term in self.prior.terms if term.name)

    def objects(self) -> SiteObjects:
        """Return the mirror planes that static ends share."""
        images = self.prior.find_term(Images)
        return SiteObjects.from_arrays(planes=None if images is None else images.planes.numpy())

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; factors of runs are estimated by likelihood where there are several.

        Raises:
            ValueError: channels of another shape than the field's.
        """
        if tuple(data.target.shape[1:]) != self.channel:
            raise ValueError(
                f"channels of shape {tuple(data.target.shape[1:])}, the field has {self.channel}"
            )
        self.rows = np.asarray(rows)
        runs = np.unique(data.runs_of(self.rows))
        self._condition_groups(group_channels(data, self.rows, self.by_antenna), runs, None)

    def _condition_groups(
        self, groups: tuple[Group, ...], runs: np.ndarray, factors: Tensor | None
    ) -> None:
        """Set the weights; factors of `runs` (R,), as measured, are estimated unless given."""
        prior = self.prior
        both = zip(prior.signal_covariances(groups), groups, strict=True)
        covariances = [signal + prior.disturbance(group) for signal, group in both]
        factors, solutions = fit_run_factors(groups, covariances, len(runs), factors)
        self.runs = RunFactors(runs, factors)
        rest = prior.noise, prior.is_real
        self.weights = tuple(
            GroupWeights(group, solution, max(solution.power, TINY), *rest)
            for group, solution in solutions
        )
        self.stations = {}
        for model in self.weights:
            self.stations.setdefault(model.group.slot.station, []).append(model)
        heard = [(model.group, model.given.weights, model.scale) for model in self.weights]
        # One end alone does not tell what ends have in common.
        self.common = SharedGains.from_groups(prior, heard) if len(self.stations) > 1 else None

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`.

        Without stations those at the static places are asked, the first of several at one. Of one
        that no row was learned of, what ends have in common answers (`SharedGains`).
        """
        # The longest group's covariance with a chunk is the largest matrix of an answer.
        longest = max(len(each.group) for each in self.require_fitted(self.weights or None))
        ends = Ends.from_query(self.site, query)
        dtype, device = query.tx.dtype, query.tx.device
        parts = [
            self._predict_part(ends.rows(part), dtype)
            for part in torch.arange(len(ends)).split(max(ENTRIES // longest, 1))
        ]
        mean, share, after, before = (torch.cat(each) for each in zip(*parts, strict=True))
        prediction = Prediction(
            mean.to(device),
            after.to(dtype).to(device),
            (after / before.clamp_min(TINY)).clamp(0, 1).to(dtype).to(device),
            share.to(device) if self.count_components() else None,
        )
        return self.runs.apply_factors(prediction, query.run)

    def _predict_part(
        self, ends: Ends, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean and images' share (B, A, K) of parts `dtype`,
        variance after and before learning (B,).
        """
        prior, images, size = self.prior, self.prior.find_term(Images), math.prod(self.channel)
        mean = torch.zeros(len(ends.moving), *self.channel, dtype=dtype.to_complex())
        # Without images it is not told, and needs no memory of its own.
        share = mean if images is None else torch.zeros_like(mean)
        after, before = (torch.zeros(len(ends.moving), dtype=torch.float64) for _ in range(2))
        exact = dtype == torch.float64

        def add_slot(
            slot: Slot, rows: Tensor, values: Tensor, variance: Tensor, power: Tensor
        ) -> None:
            slot.write_entries(mean, rows, values)
            for total, part in ((after, variance), (before, power)):
                # Variances are means over all A K entries, of which this slot has so many.
                total.index_add_(0, rows, part * (values.shape[1] / size))

        for alike in self.group_by_places(ends):
            slot_places = [SlotPlaces(model.group.slot, places) for model, _, places in alike]
            crosses = prior.end_covariances(slot_places, [model.group for model, _, _ in alike])
            for (model, own, _), at, cross in zip(alike, slot_places, crosses, strict=True):
                if images is not None:
                    at.slot.write_entries(
                        share, own, model.given.mean(images.covariance(at, model.group))
                    )
                # In float64 slopes of variances are asked for, which a rounded root would spoil.
                removed = (
                    model.given.explained_variance(cross)
                    if exact
                    else model.explained_variance(cross)
                )
                whole = prior.variance(at) + prior.disturbance_variance
                posterior_variance = model.scale * (whole - removed).clamp_min(0)
                add_slot(
                    at.slot, own, model.given.mean(cross), posterior_variance, model.scale * whole
                )
        unheard = torch.tensor(
            [number not in self.stations for number in ends.station.tolist()], dtype=torch.bool
        )
        for place in ends.still[unheard].detach().unique(dim=0):
            own = torch.nonzero(unheard & (ends.still == place).all(1)).flatten()
            if self.common is None:
                raise ValueError(
                    "waves: one static end was learned from, which tells nothing of another"
                )
            # What ends have in common, in its entries
            for model in next(iter(self.stations.values())):
                slot, outputs = model.group.slot, model.group.target.shape[1]
                # Antennas of the new end stand about its place as those of the known one do.
                middle = torch.from_numpy(self.site.every_station.position[slot.station])
                slot = replace(slot, end=slot.end + place - middle)
                at = SlotPlaces(slot, slot.antenna_places(ends.moving[own], ends.turned[own]))
                common, posterior_variance, whole = self.common.predict(prior, at)
                add_slot(slot, own, common[:, None].expand(-1, outputs), posterior_variance, whole)
        return mean, share, after, before

    def group_by_places(self, ends: Ends) -> list[list[tuple[GroupWeights, Tensor, Tensor]]]:
        """Return weights with the queries (m,) they answer and their places (m, 3),
        in lists of equal places.
        """
        alike: dict[tuple[Any, ...], list[tuple[GroupWeights, Tensor, Tensor]]] = {}
        for number in ends.station.unique().tolist():
            own = torch.nonzero(ends.station == number).flatten()
            for model in self.stations.get(number, ()):
                slot, learned = model.group.slot, model.group
                places = slot.antenna_places(ends.moving[own], ends.turned[own])
                fingerprints = (
                    to_numpy(positions).tobytes() for positions in (places, learned.places[:1])
                )
                key = slot.wavenumber, learned.displacement_key, *fingerprints
                alike.setdefault(key, []).append((model, own, places))
        return list(alike.values())

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """See `ClosedForm`; in the phase and level of each row's own run.

        What rows have in common by their order alone is not predicted: no query has it.
        """
        mean = torch.zeros(len(self.rows), *self.channel, dtype=torch.complex64)
        variance, entries = (
            torch.zeros(len(self.rows)).double(),
            torch.zeros(len(self.rows)).double(),
        )
        for model in self.require_fitted(self.weights or None):
            group, outputs = model.group, model.group.target.shape[1]
            other = self.prior.disturbance(group).to(torch.complex128)
            residual, error = model.given.left_out_signal(other)
            assert error is not None
            predicted = group.target - residual
            group.slot.write_entries(
                mean, group.rows, predicted * self.runs.factors[group.run][:, None]
            )
            # Weighed by entries of the group, as the sum is divided by those of all groups.
            level = model.scale * outputs * self.runs.factors[group.run].abs().square()
            variance.index_add_(0, group.rows, error * level)
            entries.index_add_(0, group.rows, torch.full_like(error, float(outputs)))
        return LeftOutRows(self.rows, mean, (variance / entries.clamp_min(1)).float())

    def state(self) -> dict[str, Any]:
        """See `Method.state`; factors are computed again by `restore`."""
        groups = [each.group for each in self.require_fitted(self.weights or None)]
        return {
            "prior": self.prior.state(),
            "channel": list(self.channel),
            "rows": torch.from_numpy(self.rows),
            "runs": to_plain(self.runs),
            "groups": [group.state(self.runs.factors) for group in groups],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        antennas, tones = (int(n) for n in state["channel"])
        self.site, self.channel = site, (antennas, tones)
        self.prior, self.rows = ChannelPrior.read(state["prior"]), state["rows"].numpy()
        runs = from_plain(state["runs"])
        self._condition_groups(tuple(map(Group.read, state["groups"])), runs.runs, runs.factors)
