"""One copy of a method for each station, and one over all stations for those that it never heard.

Methods know one static end. Measurements with several are several such sites that share their
places: a copy is fitted to the rows of each. A station without training rows is answered by a copy
that takes both ends for moving, so that its query is (tx, rx), where the method can do that.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.base.errors import Caution, Severe, group_warnings, list_first
from gsparc.base.executor import run_all, uses_other_processes
from gsparc.data.ends import NOBODY, SAME_PLACE_M, Ends, station_distances
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import LEAST_ROWS, Fold
from gsparc.models import checkpoint, fitting
from gsparc.models.abilities import AddsCarriers, HasJoint
from gsparc.models.closed_form import method_state
from gsparc.models.fitting import common_label
from gsparc.models.method import Method, MethodFactory, Prediction, Reconditions
from gsparc.models.powers.own_terms import pool_station_weights
from gsparc.models.sanity import create_unfitted
from gsparc.models.station_sites import UNHEARD, station_site, stations_of_fold, to_station_query
from gsparc.models.station_views import OneStationView
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

# Facts of copies that add up, as seconds do; other numbers are averaged.
COUNTS = ("model/num_gaussians", "model/steps", "model/steps_taken")


def wrap_per_station(factory: MethodFactory, data: Measurements) -> MethodFactory:
    """Return what makes a method of all stations where there are several, else `factory` itself.

    Raises:
        ValueError: both ends move, and the method knows one that does.
    """
    if data.site.several:
        return PerStation(factory)
    if data.site.paired and not factory.both_ends:
        raise ValueError(f"{factory.name}: both ends move here; it needs one that stands still")
    return factory


class PerStation(Method):
    """Copies of a method by station, each made by `factory`."""

    has_parts = True

    def __init__(self, factory: MethodFactory) -> None:
        self.factory, self.name, self.guesses = factory, factory.name, factory.guesses
        self.takes_effort, self.uses_censored = factory.takes_effort, factory.uses_censored
        self._copies: dict[int, Method] = {}
        self._shared = False  # whether one copy knows all stations

    @property
    def stored_class(self) -> type[MethodFactory]:
        """What makes the copies, of which each names its own class."""
        return type(self.factory)

    @property
    def label(self) -> str:
        """That of the copies."""
        return common_label(self.name, list(self._copies.values()))

    @property
    def effects(self) -> str | None:  # type: ignore[override]
        """Those of the copies, each once."""
        effects = [copy.effects for copy in self._copies.values() if copy.effects is not None]
        return ", ".join(dict.fromkeys(effects)) or None

    def settings_read(self) -> frozenset[str]:
        """See `Method.settings_read`: that of the copies."""
        return frozenset().union(*(copy.settings_read() for copy in self._copies.values()))

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Fit every station that is asked for, or all together.

        Together, a method that shares stations learns them as they are, any other as if both ends
        moved. What an interrupted run finished is taken from its folder (`FitContext.resume`).

        Raises:
            ValueError: a station of the test rows has too few training rows, or all are learned
                together, and the method cannot take both ends for moving.
        """
        watch = Stopwatch()
        numbers = self._station_numbers(data, fold, context)
        self.site, notes = data.site, list[str]()
        resume_dir = (
            None if context.resume is None else fitting.run_folder(context.resume, fitting.STATIONS)
        )
        resumable = self.factory.resumable and context.run_dir != Path()
        if resumable and resume_dir is None:  # of an earlier run in this folder
            for file in context.run_dir.glob("station*/**/*.ckpt"):
                file.unlink()

        def fit_station(turn: int) -> tuple[Method, FitReport, float, float]:
            number = numbers[turn]
            folder = "unheard" if number == UNHEARD else f"station{number}"
            resume = None if resume_dir is None else resume_dir / folder
            # The run's `datamodule` loads rows of all stations:
            # a station's fit makes loaders of its own.
            part_context = context.for_part(folder, datamodule=None, resume=resume)
            if len(numbers) > 1:
                # Others take a second each: `run_all` says how far they are.
                level = logging.INFO if self.factory.resumable else logging.DEBUG
                turned = turn + 1, len(numbers), self._station_name(number)
                log.log(level, "%s: station %d of %d (%s)", self.name, *turned)
            rows, part = self._rows_and_measurements(data, number)
            # Folds are numbers into the station's own rows from here on.
            inner = Fold(*(np.flatnonzero(np.isin(rows, chosen)) for chosen in vars(fold).values()))
            before, cpu_before = watch.seconds, watch.cpu_seconds
            try:
                copy, report = fitting.fit_or_resume(self.factory, part, inner, part_context)
            except KeyboardInterrupt:
                # A single station's own message already names the file to go on from.
                if not resumable or len(numbers) == 1:
                    raise
                progress = (
                    f"station {turn + 1} of {len(numbers)} was interrupted, {turn} are finished"
                )
                raise KeyboardInterrupt(
                    f"{progress}; go on with ckpt_path={context.run_dir}"
                ) from None
            if resumable and len(numbers) > 1:
                extra = fitting.run_extra(report, part, inner, part_context)
                checkpoint.save(
                    part_context.run_dir / checkpoint.MODEL, copy, context.config_yaml, extra
                )
            return copy, report, watch.seconds - before, watch.cpu_seconds - cpu_before

        fits = run_all(fit_station, range(len(numbers)), f"stations of {self.name}")
        reports = [fit[1] for fit in fits]
        # The rest by the interrupted run, or another process
        for _, report, took_s, took_cpu_s in fits:
            counted_s = 0.0 if uses_other_processes() else took_cpu_s
            watch.charge(max(report.seconds - took_s, 0.0), max(report.cpu_s - counted_s, 0.0))
        heard = [
            report for report, number in zip(reports, numbers, strict=True) if number != UNHEARD
        ]
        learned = pool_station_weights([note for report in heard for note in report.notes])
        notes += dict.fromkeys(learned.values())
        nan_stations = [
            t for t in range(len(data.site.every_station)) if not {t, UNHEARD} & {*numbers}
        ]
        if who := list_first([self._station_name(number) for number in nan_stations]):
            notes.append(
                Caution(f"answers are NaN, of fewer than {LEAST_ROWS} rows: station {who}")
            )
        for turn, number in enumerate(numbers):
            self._copies[number] = fits[turn][0]
            name = "all stations" if numbers == [UNHEARD] else self._station_name(number)
            notes += [
                type(note)(f"{name}: {note}") for note in reports[turn].notes if note not in learned
            ]
        cautions = [note for note in notes if isinstance(note, Caution)]
        notes = [note for note in notes if not isinstance(note, Caution)]
        for kind in (Severe, Caution):  # a severe one is said again at the end of a run
            notes += map(kind, group_warnings([note for note in cautions if type(note) is kind]))
        cost = sum((report.cost for report in reports), Cost())
        return FitReport(watch.seconds, tuple(notes), cost, watch.cpu_elsewhere)

    def _station_numbers(self, data: Measurements, fold: Fold, context: FitContext) -> list[int]:
        """Stations that copies are made for; `UNHEARD` for all together, or for those without rows.

        Raises:
            ValueError: see `fit`.
        """
        stations = data.site.every_station
        how = context.stations
        if how == "auto":
            how, why = self.factory.choose_stations(data, fold, context)
            log.log(logging.INFO if why else logging.DEBUG, "stations=auto -> %s: %s", how, why)
        together, joint = how == "together", self.factory.learns_jointly(data.site)
        self._shared = together and joint
        if together and not (joint or self.factory.both_ends):
            raise ValueError(f"{self.name}: knows one static end; say stations=each")
        learnable, only_tested = stations_of_fold(self.factory, data, fold)
        names = list_first([stations.shown[t] for t in np.flatnonzero(only_tested)])
        numbers = [UNHEARD] if together else [int(t) for t in np.flatnonzero(learnable)]
        if not together and only_tested.any():
            if not self.factory.both_ends and not joint:
                raise ValueError(
                    f"{self.name}: cannot predict stations that it never heard ({names})"
                )
            numbers.append(UNHEARD)
        no_position = np.isnan(stations.position).any(1)
        if joint:  # it seeks those that have rows
            no_position &= only_tested & ~np.isin(
                np.arange(len(stations)), data.stations_of(fold.train)
            )
        if UNHEARD in numbers and no_position.any():
            needs = f"{self.name}: places of stations are unknown, it needs them"
            others = f" for those without training rows ({names}); give them, or split otherwise"
            raise ValueError(needs + ("; say stations=each" if together and not joint else others))
        return numbers

    def _station_name(self, number: int) -> str:
        return (
            self.fitted_site.every_station.shown[number]
            if number != UNHEARD
            else "stations never heard"
        )

    def _rows_and_measurements(
        self, data: Measurements, number: int
    ) -> tuple[np.ndarray, Measurements]:
        """Rows of the copy of a station, and the measurements as it sees them."""
        rows = np.flatnonzero((data.stations_of() == number) | (number == UNHEARD))
        return rows, data.subset(rows, self._site_of_copy(data.site, number))

    def copy_conditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; stations without rows among these are then as if never heard."""
        result = PerStation(self.factory)
        result.site, result._shared = data.site, self._shared
        for number, copy in self._copies.items():
            station_rows, part = self._rows_and_measurements(data, number)
            chosen = np.flatnonzero(np.isin(station_rows, rows))
            if len(chosen) < LEAST_ROWS:
                continue
            learned = (
                copy.copy_conditioned(part, chosen) if isinstance(copy, Reconditions) else None
            )
            # One copy that cannot, and the whole would answer from rows that were to be forgotten.
            if learned is None:
                return None
            result._copies[number] = learned
        return result if result._copies else None

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; by each station's copy."""
        if self._shared:
            return self._copies[UNHEARD].predict(query)
        stations = self._stations_of_query(query) if query.station is None else query.station
        answers: list[tuple[Tensor, Prediction]] = []
        for number in stations.unique().tolist():
            chosen, copy = (stations == number).nonzero()[:, 0], self.station_method(number)
            answers.append(
                (chosen, copy.predict(to_station_query(copy.fitted_site, query.rows(chosen))))
            )
        # Answers come station by station; `joined` puts them back in the query's order.
        rows, parts = zip(*answers, strict=True)
        return Prediction.joined(parts, torch.argsort(torch.cat(rows)))

    def gradient_problem(self) -> str | None:
        """See `Method.gradient_problem`; that of any copy."""
        return next(filter(None, (copy.gradient_problem() for copy in self._copies.values())), None)

    def station_method(self, number: int) -> Method:
        """Return the copy that answers for a station.

        Raises:
            ValueError: it had too few training rows, and there is no copy for such stations.
        """
        copy = self._copies.get(number, self._copies.get(UNHEARD))
        if copy is None:
            raise ValueError(
                f"{self.name}: station {self._station_name(number)} had too few training rows"
            )
        return OneStationView(copy, number) if self._shared else copy

    @property
    def shared_copy(self) -> Method | None:
        """The copy that knows all stations; None: each has its own."""
        return self._copies[UNHEARD] if self._shared else None

    def with_shared_copy(self, method: Method) -> PerStation:
        """Return the same with another copy that knows all stations."""
        result = PerStation(self.factory)
        result.site, result._copies, result._shared = self.site, {UNHEARD: method}, True
        return result

    def joint_method(self) -> HasJoint | None:
        """See `Method.joint_method`; None: each has a copy of its own."""
        shared = self.shared_copy
        return None if shared is None else OneStationView(shared, NOBODY).joint_method()

    def add_carrier(self, frequency_hz: float) -> PerStation:
        """See `AddsCarriers`."""
        copy, site = self._copies.get(UNHEARD), self.fitted_site
        if not self._shared or not isinstance(copy, AddsCarriers):
            reason = (
                "knows its own carriers alone" if self._shared else ("learned each carrier alone")
            )
            raise ValueError(f"{self.name} {reason}; model=carriers answers at others")
        result = PerStation(self.factory)
        result._copies, result._shared = {UNHEARD: copy.add_carrier(frequency_hz)}, True
        result.site = replace(site, stations=site.every_station.add_carrier(frequency_hz))
        return result

    def _site_of_copy(self, site: Site, number: int) -> Site:
        """The site as a copy sees it: whole, where one learns several stations as such."""
        return (
            site
            if number == UNHEARD and self.factory.learns_jointly(site)
            else station_site(site, number)
        )

    def _stations_of_query(self, query: Query) -> Tensor:
        """Numbers (B,) of the stations that the static ends are; `ValueError` where none stands,
        or two.
        """
        ends, stations = Ends.from_query(self.fitted_site, query), self.fitted_site.every_station
        near = station_distances(torch.from_numpy(stations.position), ends.still) <= SAME_PLACE_M
        for shared in near[near.sum(1) > 1][:1] if set(self._copies) != {UNHEARD} else ():
            # Sectors of one mast, or carriers.
            names = " and ".join(stations.shown[t] for t in shared.nonzero()[:, 0].tolist())
            raise ValueError(
                f"{self.name}: {names} stand at one place, which does not tell them apart"
            )
        for row in (~near.any(1)).nonzero()[:1, 0].tolist() if UNHEARD not in self._copies else ():
            raise ValueError(
                f"{self.name}: no station stands within {SAME_PLACE_M:g} m of row {row}, and each "
                "was learned alone; stations=together learns what they share, for new places"
            )
        return ends.station

    def state(self) -> dict[str, Any]:
        """Return the class and state of every copy, by its station's number."""
        copies = {str(number): method_state(copy) for number, copy in self._copies.items()}
        return {"per_station": copies, "shared": self._shared}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self._shared = site, bool(state["shared"])
        for number, part in state["per_station"].items():
            self._copies[int(number)] = copy = create_unfitted(self.factory, part["target"])
            copy.name = self.name
            copy.restore(self._site_of_copy(site, int(number)), part["state"])

    def objects(self) -> SiteObjects:
        """Return those of all copies: what stands in a site stands there for all its stations."""
        return reduce(
            SiteObjects.joined,
            (copy.objects() for copy in self._copies.values()),
            SiteObjects.from_arrays(),
        )

    def count_components(self) -> int:
        """Return that of all copies."""
        return sum(copy.count_components() for copy in self._copies.values())

    def facts(self) -> dict[str, float | int | str | None]:
        """Sum over copies what counts or costs, and average other numbers;
        initialisers of all are named.
        """
        result = [copy.facts() for copy in self._copies.values()]
        if not result:
            return super().facts()
        return {name: _combine_facts([facts[name] for facts in result], name) for name in result[0]}

    def __iter__(self) -> Iterator[tuple[int, Method]]:
        return iter(self._copies.items())


def _combine_facts(facts: list[Any], name: str) -> float | int | str | None:
    """A fact of all copies."""
    values = [value for value in facts if value is not None]
    if not values:
        return None
    if isinstance(values[0], str):
        return ", ".join(dict.fromkeys(values))
    return sum(values) if name in COUNTS or name.startswith("time/") else float(np.mean(values))
