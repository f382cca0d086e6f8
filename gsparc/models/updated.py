"""A map of powers with what later rows say of it; what it was learned from stays as it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gsparc.data.ends import NOBODY, Ends
from gsparc.data.query import Query
from gsparc.data.schema import Site
from gsparc.models.abilities import AddsLinks, HasProcess
from gsparc.models.checkpoint_content import CheckpointError, find_non_finite
from gsparc.models.method import Method, MethodFactory, Prediction
from gsparc.models.per_station import PerStation
from gsparc.models.reduced import View
from gsparc.models.station_views import OneStationView
from gsparc.models.target_rows import linear_moments
from gsparc.processes.averages import MeanVariance
from gsparc.processes.changes import Belief, correct
from gsparc.processes.later_rows import TINY, LaterRows
from gsparc.processes.powers import PowerRows
from gsparc.processes.stored import Stored, from_plain

STORED = "updates"  # in what a checkpoint holds besides
UNSAID = 1.0  # variance of powers, of their square, where a method states none
# Share of a stated variance that counts as the map's own error where nothing tells it apart
SIGNAL = 0.2


def known_only(stations: Mapping[int, LaterRows]) -> dict[int, LaterRows]:
    """Return rows of stations that the map knows, by number; see `Changes.new` for the others."""
    return {number: rows for number, rows in stations.items() if number > NOBODY}


@dataclass(frozen=True)
class Changes(Stored):
    """What came after a map was learned.

    Attributes:
        belief: see there.
        rows: later rows, a pair of station and rows each; 0 stands for a site with one station.
        new: local places of stations that came later [m], whose rows stand under `NOBODY` - 1, - 2,
            and so on.
        next_number, next_batch: of the row and of the update that come next.
    """

    belief: Belief
    rows: tuple[tuple[int, LaterRows], ...] = ()
    next_number: int = 0
    next_batch: int = 0
    new: tuple[tuple[float, float, float], ...] = ()

    @classmethod
    def read(cls, state: Mapping[str, Any]) -> Changes:
        """Return those of a file.

        Raises:
            ValueError: an older one, in which levels were set by hand.
        """
        if state.get("shifts"):
            raise ValueError("levels were moved by `shift`, which is no more; tell rows instead")
        return super().read({name: part for name, part in state.items() if name != "shifts"})

    @property
    def links(self) -> PowerRows | None:
        """Rows of new stations that were heard, at places (n, 6) of both ends; None: none."""
        parts = [(n, rows[~rows.silent]) for n, rows in self.rows if n < NOBODY]
        rows = reduce(LaterRows.join, (rows for _, rows in parts), LaterRows.empty())
        if not len(rows):
            return None
        number = np.repeat([NOBODY - 1 - n for n, _ in parts], [len(part) for _, part in parts])
        places = np.concatenate([rows.places.numpy(), np.array(self.new)[number]], 1)
        level = (rows.level + rows.missed).numpy()
        return PowerRows(places, level, np.zeros(len(rows), np.int8))

    @property
    def stations(self) -> dict[int, LaterRows]:
        """Later rows by station."""
        return dict(self.rows)

    def check(self) -> None:
        """Raise `ValueError` where parts do not go together, as in a damaged file."""
        for station, rows in self.rows:
            sizes = {name: len(part) for name, part in vars(rows).items()}
            unknown = NOBODY - 1 - station >= len(self.new)
            if unknown or len(set(sizes.values())) > 1 or rows.places.shape[1:] != (3,):
                raise ValueError(f"rows of station {station}: {sizes}")
        if self.belief.names and len(self.belief.weight) != len(self.belief.names):
            raise ValueError(
                f"{len(self.belief.weight)} weights of {len(self.belief.names)} stations"
            )


@dataclass(frozen=True)
class Level:
    """A map's level (B,) [dB], the variance of its error,
    and that of a measurement's noise [dB^2].
    """

    mean: Tensor
    doubt: Tensor
    noise: Tensor

    def __getitem__(self, chosen: Tensor) -> Level:
        """Return the rows `chosen`."""
        return Level(self.mean[chosen], self.doubt[chosen], self.noise[chosen])


def map_level(method: Method, prediction: Prediction, site: Site) -> Level:
    """Return what a map of powers of a site said,
    its variance told apart into its error and noise.
    """
    spread = torch.full((len(prediction.mean),), UNSAID) * prediction.mean[:, 0].square()
    spread = spread if prediction.variance is None else prediction.variance
    moments = site.target.moments_in_error_unit(prediction.mean[:, 0], spread)
    mean, variance = (part.detach().double() for part in moments)
    process = method.process() if isinstance(method, HasProcess) else None
    if process is None:
        return Level(mean, SIGNAL * variance, (1 - SIGNAL) * variance)
    noise = variance.clamp_max(process.noise)
    return Level(mean, variance - noise, noise)


class Updated(View):
    """Answers of `inner` with later rows.

    Args:
        inner: fitted to powers.
        changes: of all stations.
        own: the station that it answers for; None: as a query says.
    """

    no_gradient = (
        "later rows were told to it: gradients are those of the map before, from its first file"
    )

    def __init__(self, inner: Method, changes: Changes, own: int | None) -> None:
        super().__init__(inner)
        self.changes, self.own, self.site = changes, own, inner.fitted_site
        links = changes.links
        self.told = inner if links is None else _with_links(inner, links)

    @property
    def stored_class(self) -> type[MethodFactory]:
        """That of the map: later rows are stored beside it."""
        return self.inner.stored_class

    @property
    def label(self) -> str:
        """The map's, and that rows came later."""
        return f"{self.inner.label}, updated"

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`."""
        prediction = self.told.predict(query)
        before = map_level(self.told, prediction, self.fitted_site)
        now = self._level_now(query, before)
        unknown = None
        if prediction.unknown is not None:
            share = (now.doubt + before.noise) / (before.doubt + before.noise + TINY)
            unknown = (prediction.unknown * share).clamp(0, 1).to(prediction.unknown.dtype)
        power, variance = linear_moments(now.mean, now.doubt + before.noise)
        kind = prediction.mean.dtype
        return Prediction(power.to(kind), variance.to(kind), unknown)

    def change(self, query: Query) -> MeanVariance:
        """Return what changed since the map was learned: mean (B,) [dB] and variance (B,)
        [dB^2].
        """
        before, told = (
            map_level(method, method.predict(query), self.fitted_site)
            for method in (self.inner, self.told)
        )
        # Of a map that is taken for true only a change is not known.
        now = self._level_now(query, replace(told, doubt=0 * told.doubt))
        return MeanVariance(now.mean - before.mean, now.doubt)

    def _level_now(self, query: Query, before: Level) -> Level:
        mean, doubt = before.mean.clone(), before.doubt.clone()
        rows = self.changes.stations
        places = query.places(self.fitted_site)
        number = Ends.from_query(self.fitted_site, query).station
        number = number if self.own is None else torch.full((len(query),), self.own)
        for station in number[number != NOBODY].unique().tolist():
            at = (number == station).nonzero()[:, 0]
            if len(later := rows.get(station, LaterRows.empty())) or self.changes.belief.common:
                mean[at], doubt[at] = correct(
                    self.changes.belief, station, later, places[at], mean[at], doubt[at]
                )
        return Level(mean, doubt, before.noise)

    def state(self) -> dict[str, Any]:  # type: ignore[override]
        """Return that of the map: later rows are stored beside it."""
        return self.inner.state()

    def facts(self) -> dict[str, float | int | str | None]:
        """Return those of the map."""
        return self.inner.facts()


@contextmanager
def refuse_damaged_updates(path: Path | str = "the checkpoint") -> Iterator[None]:
    """Raise `CheckpointError` in place of what reading damaged later rows of a file raises."""
    try:
        yield
    except (TypeError, ValueError, LookupError, AttributeError, RuntimeError) as error:
        fault = (
            f"its later rows ({STORED}) are damaged ({error}); take another copy, or the one "
            "before them"
        )
        raise CheckpointError(f"{path}: {fault}") from None


def stored_changes(extra: Mapping[str, Any], path: Path | str = "the checkpoint") -> Changes | None:
    """Return what came after the map of a checkpoint, of its last version; None: nothing.

    Raises:
        CheckpointError: any version of it is damaged.
    """
    with refuse_damaged_updates(path):
        parts = [version["state"]["changes"] for version in extra.get(STORED, ())]
        if where := find_non_finite(parts, STORED):
            raise ValueError(f"{where} is NaN or infinite")
        changes = [from_plain(part) for part in parts]
        for version in changes:
            version.check()
    return changes[-1] if changes else None


def linked_stations(method: Method) -> list[int] | None:
    """Return `AddsLinks.linked_stations` of a method, or of the only one that it holds."""
    member = next(iter(method))[1] if isinstance(method, PerStation) else method
    member = getattr(member, "member", member)
    return member.linked_stations if isinstance(member, AddsLinks) else None


def _with_links(method: Method, rows: PowerRows) -> Method:
    """A method with rows of new stations."""
    member: Any = getattr(method, "member", method)
    learned = member.add_links(rows)
    if member is method:
        return cast(Method, learned)
    result = copy(method)
    result.members = [learned]  # type: ignore[attr-defined]
    return result


def with_changes(method: Method, changes: Changes | None, own: int | None = None) -> Method:
    """Return a method with later rows in place of what it had of them; None, or none:
    as it was learned.

    `own` is the number of the station that the method alone answers for; None: it knows all.
    """
    changes = changes if changes is not None and changes.rows else None
    if isinstance(method, OneStationView):
        view = copy(method)
        view.inner = with_changes(method.inner, changes)
        return view
    if isinstance(method, PerStation):
        result = copy(method)
        result._copies = {
            number: _with_own(copy_of_station, changes, number)
            for number, copy_of_station in method
        }
        return result
    alone = method.site is None or method.site.stations is None
    return _with_own(method, changes, own or 0 if alone else None)


def _with_own(method: Method, changes: Changes | None, own: int | None) -> Method:
    inner = method.inner if isinstance(method, Updated) else method
    return (
        inner
        if changes is None
        else Updated(inner, changes, None if own is not None and own < 0 else own)
    )
