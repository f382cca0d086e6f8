"""Later rows: told to a `Predictor`, forgotten, undone, and what they say of changes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
import torch

from gsparc.base.errors import DataError
from gsparc.base.limits import POSITIVE, check_arguments, switch, whole
from gsparc.data.ends import NOBODY, SAME_PLACE_M, stations_at
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.units import PowerUnit
from gsparc.models.method import Method
from gsparc.models.per_station import PerStation
from gsparc.models.predicting import predict_with_threads
from gsparc.models.station_sites import station_site
from gsparc.models.station_views import AnywhereView, OneStationView
from gsparc.models.updated import (
    STORED,
    Changes,
    Level,
    Updated,
    known_only,
    linked_stations,
    map_level,
    refuse_damaged_updates,
    stored_changes,
    with_changes,
)
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.drift import ROWS, Alarm, Watch
from gsparc.prediction.later_rows import (
    LevelRows,
    check_updatable,
    read_level_arrays,
    read_level_rows,
)
from gsparc.prediction.query import Asked
from gsparc.processes.changes import Belief, correct, learn_changes, refit_scale
from gsparc.processes.later_rows import LaterRows
from gsparc.processes.stored import Stored, from_plain, to_plain

WINDOW = 1_000  # later rows of a station that are kept
JOURNAL = 1_000  # lines that a version keeps
VERSIONS = 11  # that are kept, the one that answers among them
LIMITS = {
    "window": whole(1),
    "false_alarm": POSITIVE,
    "refit": switch(),
}
LOUD = 2.0  # deviations that a map must be above a level for silence to contradict it


@dataclass(frozen=True)
class Version(Stored):
    """What later rows made of a map.

    Attributes:
        changes: rows, and what they say together.
        watch: state of the sequential test.
        journal: a line for each thing that was done, the last ones, in their order.
        told: keys of the rows, the last ones.
    """

    changes: Changes
    watch: Watch
    journal: tuple[str, ...] = ()
    told: tuple[str, ...] = ()


class ToldBefore(DataError):
    """Rows that a model was told before, by their key."""


@dataclass(frozen=True)
class Found:
    """What an update found.

    Attributes:
        rows: (n,) numbers of the new rows, for `forget`.
        deviations: (n,) what each missed of map and earlier rows, over its standard deviation.
        alarms: changes that were noticed with these rows.
        skipped: rows that tell nothing: silence where little was expected, or of a station without
            a map.
    """

    rows: np.ndarray
    deviations: np.ndarray
    alarms: tuple[Alarm, ...]
    skipped: int


class UpdateMixin(Asked):
    """What a `Predictor` of powers learns after its fit, at settings as they are."""

    versions: tuple[Version, ...]
    _prepared: list[Method]
    _model_site: Site
    _own_station: int | None
    _answer_unit: Callable[[str | None], PowerUnit]

    @property
    @abstractmethod
    def stations(self) -> list[str]:
        """See `Predictor`."""

    def update(
        self,
        rows: Measurements | LevelRows | None = None,
        *,
        tx: Any = None,
        rx: Any = None,
        rssi: Any = None,
        unit: str | None = None,
        window: int = WINDOW,
        false_alarm: float = ROWS,
        refit: bool = False,
        key: str | None = None,
        **others: Any,
    ) -> Found:
        """Condition on rows that came later, and tell what changed.

        The map that was fitted stays as it is; rows say what to add to it. See `docs/changes.md`.

        >>> before = float(predictor.rssi(rx=[2.0, 1.0, 1.5])[0])
        >>> found = predictor.update(rx=[[2.0, 1.0, 1.5]] * 4, rssi=[before - 20] * 4)
        >>> bool(predictor.rssi(rx=[2.0, 1.0, 1.5])[0] < before - 5), len(found.rows)
        (True, 4)
        >>> predictor.undo()
        >>> bool(predictor.rssi(rx=[2.0, 1.0, 1.5])[0] == before)
        True

        Args:
            rows: measurements in the model's coordinates (`align_to_site`); None: the arrays that
                follow.
            tx, rx: (n, 3) places of the end that moves, world [m]; of both ends, where stations
                stand at several places, and then at any.
            rssi: (n,) or (n, T) powers, of both ends (n,); NaN is not measured, minus infinity (a
                power of 0) tells nothing.
            unit: of `rssi`; None: that of the measurements.
            window: later rows of a station that are kept, at least 1; the first ones are dropped.
            false_alarm: readings to a false alarm without any change, at least, in the mean.
            refit: fit the length over which changes vary to the rows kept, too; tenths of a second.
            key: a name of these rows, which are taken once; None: as often as they are told.
            **others: such as `spectrum`, refused.

        Raises:
            ValueError: no powers, both ends move, arrays or settings that cannot be.
            ToldBefore: rows of this key are known.
            TypeError: no such argument.
        """
        check_updatable(self.site)
        check_arguments(locals(), **LIMITS)
        if others:
            raise TypeError(f"update: takes rssi=, not {next(iter(others))}=")
        version, first, silent = self._current, self._current.changes.next_number, 0
        if key in version.told:
            raise ToldBefore(f"update: {key} was told before")
        if rows is None:
            places, still = (tx, rx) if self.site.moving_end == "tx" else (rx, tx)
            known = still if self.site.several else None
            levels = self.site, places, rssi, self._answer_unit(unit), known
            rows, silent = read_level_arrays(*levels)
        rows = read_level_rows(rows, self.site) if isinstance(rows, Measurements) else rows
        rows, changes = self._number_new(rows, version.changes)
        belief, stations = changes.belief, changes.stations
        extent = belief.extent
        new = self._read_rows(rows, changes)
        before = {name: stations.get(name, later[:0]) for name, later in new.items()}
        for name, later in new.items():
            stations[name] = before[name].join(later)[-window:]
        watch = version.watch.look(known_only(stations), first, extent, false_alarm)
        stations |= {n: watch.of_now(n, rows) for n, rows in known_only(stations).items()}
        numbers = np.arange(first, first + sum(map(len, new.values())))
        deviations = np.zeros(len(numbers))
        for name, later in new.items():
            now = correct(belief, name, before[name], later.places, later.level, later.doubt)
            variance = now.variance + later.noise + belief.of(name)[1]
            surprise = (later.level + later.missed - now.mean) / variance.sqrt()
            deviations[later.number.numpy() - first] = surprise.numpy()
        alarms, skipped = (
            watch.alarms[len(version.watch.alarms) :],
            silent + len(rows) - len(numbers),
        )
        entry = f"update: {len(numbers)} rows, {skipped} skipped, {len(alarms)} alarms"
        if refit:
            belief = replace(belief, scale=refit_scale(stations, belief))
            entry += f", lengths of changes at {belief.scale:.2g} of the usual"
        changes = replace(
            changes,
            belief=belief,
            next_number=first + len(numbers),
            next_batch=changes.next_batch + 1,
        )
        self._add_version(stations, entry, changes, watch, key)
        return Found(numbers, deviations, self._in_world(alarms), skipped)

    def forget(self, rows: Any) -> None:
        """Forget later rows by their numbers (see `measured`); what the map was learned from stays.

        Raises:
            ValueError: no later row has such a number.
        """
        gone, stations = np.atleast_1d(np.asarray(rows)), self._current.changes.stations
        if gone.size and gone.dtype.kind not in "iu":
            raise ValueError(f"forget: rows={rows!r}: whole numbers are needed; see `measured`")
        if len(unknown := np.setdiff1d(gone, self.rows)):
            raise ValueError(
                f"forget: no later row that is kept has number {unknown[0]}; see `measured`"
            )
        remainder = {
            n: station[~torch.isin(station.number, torch.as_tensor(gone, dtype=torch.int64))]
            for n, station in stations.items()
        }
        self._add_version(remainder, f"forget: {len(gone)} rows")

    def undo(self, count: int = 1) -> None:
        """Go back so many versions, bit for bit; `ValueError` where so many are not kept."""
        whole(1).check("count", count)
        if not count < len(self.versions):
            raise ValueError(f"undo: {count} back, {max(len(self.versions) - 1, 0)} are kept")
        self._become(self.versions[:-count])

    def change(self, tx: Any = None, rx: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return how many decibels a station's level changed since the fit, and the deviation (B,)
        of that.

        >>> found = predictor.update(rx=[[2.0, 1.0, 1.5]] * 4, rssi=[-90.0] * 4)
        >>> change, deviation = predictor.change(rx=[[2.0, 1.0, 1.5]])
        >>> bool(change < 0), predictor.undo()
        (True, None)
        """
        placed, method = self.queries.query(tx, rx), self.method
        query = placed.query
        if isinstance(method, OneStationView):
            query = method.of_station(query)
            method = method.inner
        if not isinstance(method, Updated):
            return np.zeros(len(query)), np.zeros(len(query))
        mean, variance = method.change(query)
        return placed.by_station(mean).numpy(), placed.by_station(variance.sqrt()).numpy()

    @property
    def rows(self) -> np.ndarray:
        """Numbers (n,) of the later rows that are kept, in the order they came."""
        return self.measured["number"]

    @property
    def measured(self) -> dict[str, np.ndarray]:
        """Later rows that are kept, as they came: `number`, `batch`, `station`, `place`, `level`.

        Stations by number, places (n, 3) [m, world], levels in `site.level_unit`.
        """
        pairs = self._current.changes.rows
        parts = [pair for _, pair in pairs]
        joined = reduce(LaterRows.join, parts, LaterRows.empty())
        of = np.repeat([name for name, _ in pairs], [len(part) for part in parts]).astype(np.int64)
        result = {
            "number": joined.number,
            "batch": joined.batch,
            "station": torch.from_numpy(of),
            "place": joined.places + torch.from_numpy(self.site.origin)
            if len(joined)
            else joined.places,
            "level": joined.level + joined.missed + to_decibels(self.site.target_scale),
        }
        order = joined.number.argsort()
        return {name: value[order].numpy() for name, value in result.items()}

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Changes that were noticed, in their order; places in world coordinates [m]."""
        return self._in_world(self._current.watch.alarms)

    def _in_world(self, alarms: Sequence[Alarm]) -> tuple[Alarm, ...]:
        x, y = self.site.origin[:2].tolist()
        return tuple(
            replace(alarm, place=(alarm.place[0] + x, alarm.place[1] + y)) for alarm in alarms
        )

    @property
    def journal(self) -> tuple[str, ...]:
        """A line for each thing that was done since the fit, of the last `JOURNAL`."""
        return self._current.journal

    @property
    def told(self) -> tuple[str, ...]:
        """Keys of the rows that were told, the last `JOURNAL`."""
        return self._current.told

    # -- versions ----------------------------------------------------------------------------------

    @property
    def _current(self) -> Version:
        if self.versions:
            return self.versions[-1]
        extent = float(np.linalg.norm(np.ptp(self._model_site.moving_box[:, :3], axis=0)))
        return Version(Changes(Belief(max(extent, 1e-3))), Watch.from_site(self._model_site))

    def _add_version(
        self,
        stations: dict[int, LaterRows],
        said: str,
        changes: Changes | None = None,
        watch: Watch | None = None,
        key: str | None = None,
    ) -> None:
        """Learn from stations' rows together, and answer by it."""
        now = self._current
        changes = changes or now.changes
        belief = learn_changes(known_only(stations), changes.belief.extent, changes.belief.scale)
        changes = replace(changes, rows=tuple(sorted(stations.items())), belief=belief)
        told = now.told if key is None else (*now.told, key)[-JOURNAL:]
        version = Version(changes, watch or now.watch, (*now.journal, said)[-JOURNAL:], told)
        self._become((*(self.versions or (now,)), version)[-VERSIONS:])

    def _become(self, versions: tuple[Version, ...]) -> None:
        changes = versions[-1].changes
        whole_is_same, own = self._whole is self.method, self._own_station
        self.versions, self.method = versions, with_changes(self.method, changes, own)
        self._whole = self.method if whole_is_same else with_changes(self._whole, changes, own)
        self._prepared = []

    # -- rows --------------------------------------------------------------------------------------

    def _number_new(self, rows: LevelRows, changes: Changes) -> tuple[LevelRows, Changes]:
        """Rows with the numbers of `Changes.new`, which holds stations at new places from now on.

        Raises:
            ValueError: such rows, and a model that learns from none.
        """
        linked, count = self.linked_stations, len(self._model_site.every_station)
        unknown = ~np.isin(rows.station, np.arange(count) if linked is None else linked)
        if not unknown.any():
            return rows, changes
        if linked is None:
            raise ValueError(
                "update: rows of a transmitter at a new place; a model of many places learns them "
                "by links (`stations left out` in its notes): train again on all rows"
            )
        told = torch.tensor(changes.new, dtype=torch.float64).reshape(-1, 3)
        places = torch.from_numpy(np.unique(rows.still[unknown], axis=0))
        before = (torch.cdist(places, told) <= SAME_PLACE_M).any(1)
        new, station = torch.cat([told, places[~before]]), rows.station.copy()
        number = stations_at(new, torch.from_numpy(rows.still[unknown]))
        station[unknown] = NOBODY - 1 - number.numpy()
        changes = replace(changes, new=tuple(map(tuple, new.tolist())))
        return replace(rows, station=station), changes

    @property
    def linked_stations(self) -> list[int] | None:
        """Numbers of stations with rows, where rows of others can be told, too; None: they cannot.

        Asked about one station it learns of no other.
        """
        alone = self._own_station is not None
        return None if alone else linked_stations(with_changes(self.method, None))

    def _read_rows(self, rows: LevelRows, changes: Changes) -> dict[int, LaterRows]:
        """New rows of each station that has a map, as they miss it."""
        method, site = with_changes(self.method, None), self.site
        if self._own_station is not None:
            if rows.station.any():
                raise ValueError(
                    "update: rows of several stations; tell them to the model of all of them"
                )
            rows = replace(rows, station=np.full(len(rows), self._own_station))
        number, result = np.full(len(rows), -1), {}
        levels: dict[int, tuple[np.ndarray, Level]] = {}
        for name in np.unique(rows.station).tolist():
            index = np.flatnonzero(rows.station == name)
            try:
                answers = method.station_method(name) if isinstance(method, PerStation) else method
            except ValueError:  # it had too few rows to be learned
                continue
            there = station_site(site, name) if isinstance(method, PerStation) else site
            if name < NOBODY:
                place = np.array(changes.new[NOBODY - 1 - name])
                there = replace(site, stations=None, static_position=place)
                answers = AnywhereView(method)
            query = Query.from_places(there, torch.from_numpy(rows.places[index]).float())
            level = map_level(answers, predict_with_threads(answers, query), site)
            missed = rows.decibels[index] - level.mean.numpy()
            # Of silence only a level is known that the power is below.
            tells = missed * -rows.side[index] > LOUD * np.sqrt((level.doubt + level.noise).numpy())
            used = np.flatnonzero((rows.side[index] == 0) | tells)
            levels[name] = index[used], level[torch.from_numpy(used)]
            number[index[used]] = 0
        number[number == 0] = changes.next_number + np.arange((number == 0).sum())
        for name, (index, level) in levels.items():
            missed = torch.from_numpy(rows.decibels[index]) - level.mean
            result[name] = LaterRows(
                torch.from_numpy(number[index]),
                torch.full((len(index),), changes.next_batch),
                torch.from_numpy(rows.places[index]),
                level.mean,
                missed,
                level.doubt,
                level.noise,
                torch.from_numpy(rows.side[index] != 0),
            )
        return {name: rows for name, rows in result.items() if len(rows)}


def read_versions(extra: Mapping[str, Any]) -> tuple[Version, ...]:
    """Return the versions that a checkpoint holds, the last one last;
    none where it was never updated.

    Raises:
        CheckpointError: they are damaged.
    """
    stored_changes(extra)
    with refuse_damaged_updates():
        versions = tuple(map(from_plain, extra.get(STORED, ())))
        if not all(
            isinstance(version, Version) and isinstance(version.watch, Watch)
            for version in versions
        ):
            raise TypeError("of another kind")
    return versions


def versions_extra(versions: Sequence[Version]) -> dict[str, Any]:
    """Return what a checkpoint holds of versions, for `checkpoint.update_extra`."""
    return {STORED: [to_plain(version) for version in versions]}
