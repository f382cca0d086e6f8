"""Channels of one static end or several as a Gaussian process of waves, conditioned on measured rows."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.models.channels.columns import Group, Slot, gather, query_ends, run_factors_of, static_place
from gsparc.models.channels.common import Common
from gsparc.models.channels.covariance import (
    Values,
    diffuse_of,
    directional,
    disturbance,
    explained,
    prior,
    signals,
    specular,
)
from gsparc.models.channels.initial import ChannelSettings, find_terms
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.run_factors import RunFactors
from gsparc.ops.transforms import numbers
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.factor import Factor
from gsparc.training.context import FitContext, FitReport

CHUNK = 2_000_000  # entries of a covariance that are held at a time
ROUNDED = 1e-3  # of the noise, error of variances below which half the digits do
CHECKED = 64  # rows that this is tried at
NUMBERS = ("power", "envelope", "gain", "offset", "towards", "planes")  # of `Values`


@dataclass(frozen=True)
class Weights:
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
        """(n, n), inverse of `lower`: real where that is, in single precision where variances allow it.

        A row's covariances c with all rows, its noise included, have c^H C^-1 c = C_ii: that tells the error.
        """
        whole = self.given.factor.lower
        lower = whole.real.contiguous() if self.is_real else whole
        root = Factor(lower).root
        few = lower[torch.linspace(0, len(lower) - 1, min(CHECKED, len(lower))).long()]
        short = root.to(torch.float32 if self.is_real else torch.complex64)
        squares = ((few @ lower.mH).to(short.dtype) @ short.mH).abs().square().sum(1)
        error = (squares - few.abs().square().sum(1)).abs().max()
        return short if float(error) <= ROUNDED * self.noise else root

    def learned(self, cross: Tensor) -> Tensor:
        """Variance (m,) that the rows take away from places of covariances (m, n) with them."""
        cross = (cross.real if self.is_real else cross).to(self.root.dtype)
        return (cross.conj() @ self.root.T).abs().square().sum(1)


class ChannelField(ClosedForm):
    """Leakage, direct wave, images and a diffuse field of a static end and one that moves.

    Args:
        settings: terms that are tried.
    """

    name = "waves"
    site: Site
    values: Values  # the terms and their numbers
    channel: tuple[int, int]  # (A, K) of the targets

    def __init__(self, settings: ChannelSettings | None = None) -> None:
        self.settings = settings or ChannelSettings()
        self.weights: tuple[Weights, ...] = ()
        self.stations: dict[int, list[Weights]] = {}
        self.common: Common | None = None
        self.rows = np.zeros(0, np.int64)
        self.runs = RunFactors.none()

    @classmethod
    def of(cls, site: Site, values: Values, channel: tuple[int, int]) -> ChannelField:
        """One of known terms, to be conditioned; of channels of a known carrier."""
        result = cls()
        result.site, result.values, result.channel = site, values, channel
        return result

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose terms and their powers from training and validation rows, and condition on these.

        Raises:
            ValueError: the data are no channels of a known carrier with one static end.
        """
        budget, rows = context.time_budget(), np.concatenate([fold.train, fold.val])
        self.site, self.channel = data.site, (int(data.target.shape[1]), int(data.target.shape[2]))
        self.values, notes = find_terms(data, rows, self.settings, budget)
        self.condition(data, rows)
        return FitReport(budget.counted.wall, notes, budget.limited_by)

    @property
    def apart(self) -> bool:
        """Whether antennas and tones have covariances of their own."""
        return self.values.direct or self.size() > 0

    def size(self) -> int:
        """Images."""
        return self.values.count

    @property
    def terms(self) -> tuple[str, ...]:
        """Of `residual` (diffuse field), `directions`, `leakage`, `direct`, `mirrors`, `drift`."""
        shape = self.values
        on = {
            "residual": True,
            "directions": len(shape.angles) > 0,
            "leakage": shape.constant,
            "direct": shape.direct,
            "mirrors": len(shape.sequences) > 0,
            "drift": shape.correlated,
        }
        return tuple(name for name, is_on in on.items() if is_on)

    def objects(self) -> SiteObjects:
        """The mirror planes that static ends share."""
        planes = self.values.planes.numpy()
        return SiteObjects.of(planes=planes if len(planes) else None)

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
        runs = np.zeros(1, np.int64) if data.run is None else np.unique(data.run[self.rows])
        self._solve(gather(data, self.rows, self.apart), runs, None)

    def _solve(self, groups: tuple[Group, ...], runs: np.ndarray, factors: Tensor | None) -> None:
        """Set the weights; factors of `runs` (R,), as measured, are estimated unless given."""
        values = self.values
        all_factors = [Factor.of(covariance) for covariance in _covariances(groups, values)]
        if factors is None:
            factors = run_factors_of(groups, all_factors, len(runs))
        self.runs = RunFactors(runs, factors)
        weights, noise = [], float(values.of("noise"))
        for group, factor in zip(groups, all_factors, strict=True):
            aligned = replace(group, target=group.target / factors[group.run][:, None])
            given = Conditioned(factor, aligned.target, factor.solved(aligned.target))
            weights.append(Weights(aligned, given, max(given.scale, 1e-300), noise, values.is_real))
        self.weights = tuple(weights)
        self.stations = {}
        for known in weights:
            self.stations.setdefault(known.group.slot.station, []).append(known)
        heard = [(known.group, known.given.weights, known.scale) for known in weights]
        self.common = Common.of(values, heard) if len(self.stations) > 1 else None

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`.

        Without stations those at the static places are asked, the first of several at one. Of one that no
        row was learned of, what ends have in common answers (`Common`).
        """
        moving, static, turned, station = query_ends(self.site, query.tx, query.rx)
        if query.station is not None and self.site.stations is not None:
            station = query.station.cpu()
        dtype, device = query.tx.dtype, query.tx.device
        count, longest = len(moving), max(len(each.group) for each in self._conditioned())
        parts = [
            self._answer(moving[part], static[part], turned[part], station[part], dtype)
            for part in torch.arange(count).split(max(CHUNK // longest, 1))
        ]
        mean, share, after, before = (torch.cat(each) for each in zip(*parts, strict=True))
        told = Prediction(
            mean.to(device),
            after.to(dtype).to(device),
            (after / before.clamp_min(1e-300)).clamp(0, 1).to(dtype).to(device),
            share.to(device) if self.size() else None,
        )
        return self.runs.restored(told, query.run)

    def _answer(
        self, moving: Tensor, static: Tensor, turned: Tensor, station: Tensor, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean and images' share (B, A, K) of parts `dtype`, variance after and before learning (B,)."""
        values, size = self.values, math.prod(self.channel)
        mean = torch.zeros(len(moving), *self.channel, dtype=dtype.to_complex())
        share = torch.zeros_like(mean) if self.size() else mean
        after, before = (torch.zeros(len(moving), dtype=torch.float64) for _ in range(2))
        exact = dtype == torch.float64
        disturbed = sum(values.of(name).sum() for name in ("noise", "fast", "drift"))
        for alike in self._by_places(moving, turned, station):
            slots, places, learned = (
                [one.group.slot for one, _, _ in alike],
                alike[0][2],
                alike[0][0].group.places,
            )
            powers = directional(values, slots)
            fields = diffuse_of(values, slots[0].wavenumber, powers, places, learned)
            for number, (known, here, _) in enumerate(alike):
                slot = slots[number]
                cross = fields[min(number, len(fields) - 1)] + specular(values, slot, places, learned)
                slot.put(mean, here, known.given.mean(cross))
                if self.size():
                    slot.put(share, here, known.given.mean(explained(values, slot, places, learned)))
                removed = known.given.known(cross) if exact else known.learned(cross)
                weight = known.scale * known.group.target.shape[1] / size
                whole = prior(values, slot, places) + disturbed
                after.index_add_(0, here, weight * (whole - removed).clamp_min(0))
                before.index_add_(0, here, weight * whole)
        unheard = torch.tensor([number not in self.stations for number in station.tolist()], dtype=torch.bool)
        for place in static[unheard].detach().unique(dim=0):
            here = torch.nonzero(unheard & (static == place).all(1)).flatten()
            self._of_unheard(place, here, moving, turned, mean, after, before)
        return mean, share, after, before

    def _by_places(
        self, moving: Tensor, turned: Tensor, station: Tensor
    ) -> list[list[tuple[Weights, Tensor, Tensor]]]:
        """Weights with the queries (m,) they answer and their places (m, 3), in lists of equal places."""
        by_places: dict[tuple[Any, ...], list[tuple[Weights, Tensor, Tensor]]] = {}
        for number in station.unique().tolist():
            here = torch.nonzero(station == number).flatten()
            for known in self.stations.get(number, ()):
                slot, learned = known.group.slot, known.group
                places = slot.places(moving[here], turned[here])
                first = numbers(learned.places)[0].tobytes()
                queried = numbers(places).tobytes()
                key = (slot.wavenumber, learned.displacements, first, queried)
                by_places.setdefault(key, []).append((known, here, places))
        return list(by_places.values())

    def _of_unheard(
        self,
        place: Tensor,
        here: Tensor,
        moving: Tensor,
        turned: Tensor,
        mean: Tensor,
        after: Tensor,
        before: Tensor,
    ) -> None:
        """Write what ends have in common for queries `here` of a static end at `place` (3,)."""
        assert self.common is not None
        size, values = math.prod(self.channel), self.values
        for template in next(iter(self.stations.values())):
            slot = template.group.slot
            slot = replace(slot, end=slot.end + place - static_place(self.site, slot.station))
            places = slot.places(moving[here], turned[here])
            common, variance, prior_variance = self.common.at(values, slot, places)
            outputs = template.group.target.shape[1]
            slot.put(mean, here, common[:, None].expand(-1, outputs))
            after.index_add_(0, here, variance * outputs / size)
            before.index_add_(0, here, prior_variance * outputs / size)

    def left_out(self) -> LeftOutRows:
        """See `ClosedForm`; in the phase and level of each row's own run.

        What rows have in common by their order alone is not predicted: no query has it.
        """
        values = self.values
        mean = torch.zeros(len(self.rows), *self.channel, dtype=torch.complex64)
        variance, entries = torch.zeros(len(self.rows)).double(), torch.zeros(len(self.rows)).double()
        for known in self._conditioned():
            group, outputs = known.group, known.group.target.shape[1]
            other = disturbance(values, group).to(torch.complex128)
            residual, error = known.given.left_out_signal(other)
            assert error is not None
            predicted = group.target - residual
            group.slot.put(mean, group.rows, predicted * self.runs.factors[group.run][:, None])
            level = known.scale * outputs * self.runs.factors[group.run].abs().square()
            variance.index_add_(0, group.rows, error * level)
            entries.index_add_(0, group.rows, torch.full_like(error, float(outputs)))
        return LeftOutRows(self.rows, mean, (variance / entries.clamp_min(1)).float())

    def _conditioned(self) -> tuple[Weights, ...]:
        if not self.weights:
            raise ValueError("waves: not conditioned yet; call fit or condition first")
        return self.weights

    def state(self) -> dict[str, Any]:
        """See `Method.state`; factors are computed again by `restore`."""
        groups = [each.group for each in self._conditioned()]
        return {
            "shape": self.values.state(),
            "values": {name: getattr(self.values, name) for name in NUMBERS},
            "channel": list(self.channel),
            "rows": torch.from_numpy(self.rows),
            **self.runs.state(),
            "groups": [
                {
                    **{one.name: getattr(group, one.name) for one in fields(group)},
                    "slot": _slot_state(group.slot),
                    "target": group.target * self.runs.factors[group.run][:, None],
                }
                for group in groups
            ],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        shape, antennas_tones = dict(state["shape"]), [int(n) for n in state["channel"]]
        shape["sequences"] = tuple(tuple(int(i) for i in sequence) for sequence in shape["sequences"])
        self.site, self.channel = site, (antennas_tones[0], antennas_tones[1])
        self.values, self.rows = Values(**shape, **state["values"]), state["rows"].numpy()
        runs = RunFactors.read(state)
        groups = tuple(Group(**{**each, "slot": _read(each["slot"])}) for each in state["groups"])
        self._solve(groups, runs.runs, runs.factors)


def _covariances(groups: tuple[Group, ...], values: Values) -> list[Tensor]:
    """(n, n) complex128 of each group's rows with what disturbs them, relative to its scale."""
    both = zip(signals(groups, values), groups, strict=True)
    return [signal + disturbance(values, group) for signal, group in both]


def _slot_state(slot: Slot) -> dict[str, Any]:
    """What `_read` reads; a checkpoint holds finite numbers alone, so that an unknown place is none."""
    unknown = bool(slot.end.isnan().any())
    return {**vars(slot), "end": slot.end[:0] if unknown else slot.end}


def _read(state: dict[str, Any]) -> Slot:
    end = state["end"] if len(state["end"]) else torch.full((3,), torch.nan, dtype=torch.float64)
    entries = {name: tuple(int(n) for n in state[name]) for name in ("antennas", "tones")}
    return Slot(**{**state, **entries, "end": end})
