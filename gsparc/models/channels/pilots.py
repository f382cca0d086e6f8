"""Channels heard after the fit: the waves that are known, conditioned on pilots of later runs.

Pilots y of a run are `c h + e`, c one amplitude and phase of the run, which nobody knows: the
largest likelihood has `c = m^H S^-1 y / m^H S^-1 m`, m and S the mean and covariance there of what
the field as fitted predicts, given pilots of earlier runs. Parameters stay as they are,
and no matrix of the training rows is factored again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from gsparc.data.ends import Ends
from gsparc.data.query import Query
from gsparc.models.channels.columns import SlotPlaces
from gsparc.models.channels.field import ChannelField, GroupWeights
from gsparc.models.method import Prediction
from gsparc.models.reduced import View
from gsparc.physics.decibels import TINY_POWER
from gsparc.processes.factor import Factor

CHUNK = 256  # queries that are answered at a time
KEPT = 200  # rows of pilots of a station that count, the last ones: rooms change


class _Known(NamedTuple):
    """What the training rows of a slot say of places."""

    model: GroupWeights
    own: Tensor  # (m,) rows of the ends
    at: SlotPlaces
    cross: Tensor  # (m, n) covariances with the rows
    white: Tensor  # (n, m) whitened

    def select_rows(self, there: Tensor) -> _Known:
        """Return those of some places (m,) bool."""
        at = replace(self.at, places=self.at.places[there])
        return _Known(self.model, self.own[there], at, self.cross[there], self.white[:, there])


@dataclass(frozen=True)
class _Told:
    """Pilots of a slot.

    Attributes:
        known: what training rows say there.
        factor: of the covariance of what they do not say.
        heard: (p, D) pilots.
        mean: (p, D) as predicted.
    """

    known: _Known
    factor: Factor
    heard: Tensor
    mean: Tensor

    @cached_property
    def weights(self) -> Tensor:
        """(p, D) of what the prediction missed."""
        return self.factor.solve(self.heard - self.mean)

    def undo_factor(self, factor: complex, new: Tensor) -> _Told:
        """Return the pilots of rows `new` (n,) bool of all ends without a factor."""
        mine = new[self.known.own][:, None]
        return replace(self, heard=torch.where(mine, self.heard / factor, self.heard))


class HeardField(View):
    """A field that was told of pilots; it answers in the phase and level of the last run.

    Args:
        field: fitted.
        query: places of the pilots, with stations where there are several.
        values: (n, A, K) complex, stored units, of one run; NaN where nothing was heard.
        before: the same field with the pilots of earlier runs.
        doubt: what its variances are multiplied by, see `Mixture`.
    """

    no_gradient = "pilots after the fit are answered in closed form alone"

    def __init__(
        self,
        field: ChannelField,
        query: Query,
        values: Tensor,
        before: HeardField | None = None,
        doubt: float = 1.0,
    ) -> None:
        super().__init__(field)
        self.field, self.doubt = field, doubt
        ends, values = Ends.from_query(field.site, query), values.to(torch.complex128)
        earlier = 0 if before is None else len(before.values)
        if before is not None:
            pairs = zip(vars(before.ends).values(), vars(ends).values(), strict=True)
            ends, values = Ends(*map(torch.cat, pairs)), torch.cat([before.values, values])
        last = _last_rows(ends.station, KEPT)
        self.ends: Ends = ends.rows(last)
        values, new = values[last], last >= earlier
        told = self._told_slots(self.ends, values)
        self.run_factor = _run_factor(told.values(), new)
        self.values: Tensor = torch.where(new[:, None, None], values / self.run_factor, values)
        self.told = {key: slot.undo_factor(self.run_factor, new) for key, slot in told.items()}

    def _known(self, ends: Ends) -> Iterator[list[_Known]]:
        """What is known at places, in lists of slots with equal ones."""
        prior = self.field.prior
        for alike in self.field.group_by_places(ends):
            places = [SlotPlaces(model.group.slot, at) for model, _, at in alike]
            crosses = prior.end_covariances(places, [model.group for model, _, _ in alike])
            pairs = zip(alike, places, crosses, strict=True)
            yield [
                _Known(model, own, at, cross, model.given.factor.whiten(cross.mH))
                for (model, own, _), at, cross in pairs
            ]

    def _told_slots(self, ends: Ends, values: Tensor) -> dict[int, _Told]:
        """Pilots of each slot, by who knows its training rows."""
        result, noise = {}, float(self.field.prior.disturbance_variance)
        for alike in self._known(ends):
            places = [known.at for known in alike]
            wholes = self.field.prior.end_covariances(places, places)
            for known, whole in zip(alike, wholes, strict=True):
                slot, model = known.at.slot, known.model
                heard = values[known.own][:, list(slot.antennas)][:, :, list(slot.tones)].flatten(1)
                there = heard.isfinite().all(1)
                if not there.any():
                    continue
                known = known.select_rows(there)
                covariance = whole[there][:, there] - known.white.mH @ known.white
                covariance.diagonal().add_(noise)
                mean, factor = model.given.mean(known.cross), Factor.from_gram(covariance)
                result[id(model)] = _Told(known, factor, heard[there], mean)
        return result

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        return Prediction.joined([self._predict_part(part) for part in query.split(CHUNK)])

    def _predict_part(self, query: Query) -> Prediction:
        said, ends = self.field.predict(query), Ends.from_query(self.field.site, query)
        mean, level = said.mean.clone(), self.doubt * abs(self.run_factor) ** 2
        assert said.variance is not None
        removed = torch.zeros(len(query), dtype=torch.float64)
        for known in chain.from_iterable(self._known(ends)):
            told, slot = self.told.get(id(known.model)), known.at.slot
            if told is None:
                continue
            (whole,) = self.field.prior.end_covariances([known.at], [told.known.at])
            cross = whole - known.white.mH @ told.known.white
            more = torch.zeros_like(mean)
            slot.write_entries(more, known.own, cross @ told.weights)
            mean += more
            share = len(slot.antennas) * len(slot.tones) / mean[0].numel()
            gained = told.factor.whiten(cross.mH).abs().square().sum(0)
            removed.index_add_(0, known.own, known.model.scale * share * gained)
        variance = (said.variance.double() - removed).clamp_min(0) * level
        return replace(said, mean=mean * self.run_factor, variance=variance.to(said.variance.dtype))


def _last_rows(station: Tensor, most: int) -> Tensor:
    """Numbers of the last `most` rows of each station, in order."""
    kept = [torch.nonzero(station == number)[-most:, 0] for number in station.unique()]
    return torch.cat(kept).sort().values


def _run_factor(told: Iterable[_Told], new: Tensor) -> complex:
    """The factor of the largest likelihood, see above, of the run of rows `new` (n,) bool.

    Rows of earlier runs come first and count as known.
    """
    above, below = 0j, TINY_POWER
    for slot in told:
        own = new[slot.known.own]
        known = torch.where(own[:, None], 0, slot.heard)
        # A row whitened is what it adds to those before it.
        expected = slot.factor.whiten(slot.mean - known)[own]
        heard = slot.factor.whiten(slot.heard - known)[own]
        above += complex((expected.conj() * heard).sum()) / slot.known.model.scale
        below += float(expected.abs().square().sum()) / slot.known.model.scale
    return above / below
