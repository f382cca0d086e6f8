"""The field of powers of many ends: a law and a place term of the site, a process of each end.

Stations that were heard answer by their own process about the law of the site. A station that was
never heard is answered by the law and a process of place that all stations share, as strong as
stations that were left out want it. Either end may be the station.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.base.errors import Caution, DataError
from gsparc.data.ends import NOBODY, Ends, stations_at
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.abilities import JointLevels
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.powers.prior_map import NetworkMaps, describe_use
from gsparc.models.powers.together.learning import (
    ERRORS,
    TRIED_EACH,
    StationPriors,
    learn_own_settings,
    learn_shared_terms,
    learn_station_priors,
)
from gsparc.models.powers.together.links import (
    LinkPriors,
    Links,
    both_ends_move,
    errors_of_heard,
    learn_links,
)
from gsparc.models.powers.together.network import find_sectors, learn_network, relabel_by_site
from gsparc.models.powers.together.terms import (
    SharedTerms,
    StationRows,
    places_and_notes,
    rows_of_stations,
)
from gsparc.models.target_rows import linear_moments
from gsparc.processes.factor import Factor
from gsparc.processes.neighbourhood import nearest_distance
from gsparc.processes.places import first_end
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import MOST_ROWS, REACH, PowerRows
from gsparc.processes.prior import Prior
from gsparc.processes.sectors import NO_AZIMUTH, ROUND, Sectors
from gsparc.processes.shared import SharedTermsPosterior
from gsparc.processes.stored import from_plain, to_plain
from gsparc.processes.trend import TINY_M
from gsparc.processes.uncertainty import mean_and_error
from gsparc.training.context import FitContext, FitReport
from gsparc.training.stopwatch import Stopwatch

MEMORY = 3e9  # bytes of all stations' factors
PLACES = 2 * TRIED_EACH  # that the shared process is known at in the end
TINY_DB2 = 1e-6  # least variance of a level [dB^2]
UNHEARD_EACH = 1_000  # rows of each station, for what is said of others


class JointPowerField(ClosedForm):
    """Powers of several stations, (1,) linear.

    Args:
        shared: whether they share more than the law.
        seed: of rows and places that are drawn.
        maps: of a network, from before any row.
    """

    name = "process of many stations' powers"
    site: Site
    places: np.ndarray  # (T, 3) float64 of the stations [m]
    own: StationPriors  # of the stations' own processes
    heard: SharedTerms  # shared terms for stations that have rows
    unheard: SharedTerms  # those for all others

    def __init__(
        self, shared: bool = True, seed: int = 0, maps: Sequence[NetworkMaps] = ()
    ) -> None:
        self.shared, self.seed, self.maps = shared, seed, maps
        self.inflation = 1.0  # of variances of stations never heard
        self.posterior: SharedTermsPosterior | None = None
        self.elsewhere: SharedTermsPosterior | None = None
        self.whole = 1.0  # variance of what was measured, of all stations [dB^2]
        self.rows: dict[int, Tensor] = {}  # of what was heard of each station
        self.link_priors: LinkPriors | None = None  # where both ends move
        self.links: Links | None = None
        self._reach: tuple[cKDTree, float] | None = None  # of what is known, made when it is asked

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Learn what stations share and their own processes, and condition on these rows.

        Raises:
            ValueError: not several stations, or no rows.
        """
        watch, rows = Stopwatch(), fold.learned()
        if not data.site.several:
            raise ValueError("a process of many stations' powers needs several stations")
        if not len(rows):
            raise ValueError("a process of many stations' powers needs at least one row")
        self.site, self.inflation, self.link_priors = data.site, 1.0, None
        notes = self._learn(data, rows)
        self.condition(data, rows)
        return FitReport(watch.seconds, notes)

    def _learn(self, data: Measurements, rows: np.ndarray) -> tuple[str, ...]:
        """Set the processes and what they share; what must be said of them."""
        self.places, notes = places_and_notes(data, rows)
        used = rows_of_stations(data, rows, self.places)
        network = find_sectors(data, self.places)
        if network is None:
            self.own, remarks = learn_station_priors(used, self.seed)
            if self.shared and both_ends_move(data, rows):
                remarks.append(self._share_terms(used, by_links=True))
            if self.link_priors is not None and self._links_tell_heard(used, self.link_priors):
                return (*notes, *remarks)
            self.own, more = learn_own_settings(used, self.own, self.seed)
            remarks += more
        else:
            measured, used = used, relabel_by_site(used, network)
            names = data.site.every_station.shown
            evidence, prior, remarks = learn_network(used, network, names, self.seed)
            for maps in self.maps:
                known, own, remarks_with_map = learn_network(
                    used, maps.put_under(network, self.places), names, self.seed
                )
                if used_maps := known > evidence:
                    prior, remarks = own, remarks_with_map
                # Second: a table shows the first few.
                remarks.insert(1, describe_use(used_maps, len(maps.maps)))
                remarks += map(Caution, maps.explain_misfits(measured, names))
            self.own = StationPriors(prior, {})
        most, largest = rows_per_station(len(used.stations)), int(np.bincount(used.station).max())
        if largest > most:
            remarks.append(
                f"at most {most} rows of each station are learned from, of up to {largest}"
            )
        if not self.shared or network is not None:
            self.heard = self.unheard = self._law_alone(used)
            return (*notes, *remarks)
        return (*notes, *remarks, self._share_terms(used))

    def _law_alone(self, rows: StationRows) -> SharedTerms:
        return SharedTerms.from_rows(rows, self.own.never.known_trend, 1.0, 0, self.seed)

    def _links_tell_heard(self, rows: StationRows, priors: LinkPriors) -> bool:
        """Whether links tell of stations that were heard better than the stations' own processes,
        at rows left out; else they are for others alone.
        """
        few = rows.thin_rows(TRIED_EACH, self.seed)
        own = self.own.condition(few, self.heard, self.seed)
        order = np.concatenate([np.flatnonzero(few.station == n) for n in own.processes])
        missed = np.concatenate([own.left_out(n).residual.numpy() for n in own.processes])
        errors, station = errors_of_heard(few, priors, self.seed)[order], few.station[order]
        gain, unsure = mean_and_error(missed**2 - errors**2, station)
        if gain <= ERRORS * unsure:
            self.link_priors = replace(priors, heard=None)
        return gain > ERRORS * unsure

    def _share_terms(self, rows: StationRows, by_links: bool = False) -> str:
        """Set what stations share, and links where these are better; what must be said."""
        self.heard = self.unheard = self._law_alone(rows)
        terms, self.inflation, remark, missed = learn_shared_terms(rows, self.own, self.seed)
        if terms.place_db:
            self.unheard = terms.set_inducing(rows, PLACES, self.seed)
        if missed is not None and by_links:
            self.link_priors, remark = learn_links(rows, self.own.never, missed, self.seed)
        return remark

    @property
    def network(self) -> Sectors | None:
        """Sectors whose processes those of a site share; None: each station has its own."""
        return trend if isinstance(trend := self.own.never.trend, Sectors) else None

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` always: its law is of the site."""
        return ("power", "residual")

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; silent rows say that powers are below a level."""
        own_rows = rows_of_stations(data, rows, self.places)
        own_rows = own_rows if self.network is None else relabel_by_site(own_rows, self.network)
        links = self.link_priors
        self.links = None if links is None else links.condition(own_rows.measured_rows, self.seed)
        used = own_rows.thin_rows(rows_per_station(len(own_rows.stations)), self.seed)
        self.posterior, self._reach = self.own.condition(used, self.heard, self.seed), None
        elsewhere = self.posterior
        if self.network is None:  # sites share nothing that is learned here
            elsewhere = self.own.condition(
                used.thin_rows(UNHEARD_EACH, self.seed), self.unheard, self.seed
            )
        self.elsewhere = self._unheard_posterior((elsewhere.factor, elsewhere.mean))
        self.whole = max(float(used.heard_rows.decibels.var()), self.own.variance)
        self.rows = {
            n: torch.from_numpy(used.select_station(n).measured_rows.index) for n in used.stations
        }

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; (B, 1) linear powers.

        Without stations, who stands at either end is asked; a negative one was never heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, elsewhere = self._require_posteriors()
        places, number = self._process_places(*self._places_and_stations(query))
        mean = torch.zeros(len(places), dtype=torch.float64)
        spread, share = torch.zeros_like(mean), torch.zeros_like(mean)
        heard = torch.isin(number, torch.tensor(self._heard))
        exact = query.tx.dtype == torch.float64
        for of, inflation, chosen in ((posterior, 1.0, heard), (elsewhere, self.inflation, ~heard)):
            links = self.links
            if chosen.any() and links is not None and links.of_station(of is posterior) is not None:
                mean[chosen], spread[chosen] = links.answer(places[chosen], of is posterior)
                share[chosen] = spread[chosen] / self.whole
            elif chosen.any():
                mean[chosen], variance = of.answer(places[chosen], number[chosen], exact)
                spread[chosen], share[chosen] = inflation * variance, variance / self.whole
        share = (share + self._law_share(first_end(places))).clamp_max(1.0)
        mean, spread, share = (part.to(query.tx.dtype) for part in (mean, spread, share))
        return Prediction(*linear_moments(mean, spread), share)

    @torch.no_grad()
    def predict_joint(self, moving: Tensor, stations: Tensor) -> JointLevels:
        """Return levels with the covariances of their errors, float64.

        Args:
            moving: (G, k, 3) places of the moving end [m].
            stations: (k,) int64, of each place of a group: several of one place, or one of several.
        """
        posterior, elsewhere = self._require_posteriors()
        still = torch.from_numpy(self.places)[stations].expand_as(moving)
        places = torch.cat([moving.double(), still], 2).flatten(0, 1)
        places, number = self._process_places(places, stations.repeat(len(moving)))
        places, number = places.unflatten(0, moving.shape[:2]), number[: len(stations)]
        groups, count = moving.shape[:2]
        mean, noise = torch.zeros(groups, count).double(), torch.zeros(count).double()
        covariance = torch.zeros(groups, count, count).double()
        for station in number.unique().tolist():
            at = (number == station).nonzero()[:, 0]
            of, inflation = (
                (posterior, 1.0) if station in posterior.processes else (elsewhere, self.inflation)
            )
            mean[:, at], block = of.predict_joint(places[:, at], station)
            kernel = self.own.prior(station).kernel
            noise[at], block = inflation * kernel.amplitude * kernel.noise, inflation * block
            links, is_heard = self.links, station in posterior.processes
            if links is not None and links.of_station(is_heard) is not None:
                # They have no covariances: places go together as in the station's own process.
                signal, asked = block - noise[at].diag(), places[:, at].flatten(0, 1)
                level, variance = links.answer(asked, is_heard)
                mean[:, at], noise[at] = level.view(groups, -1), links.noise(is_heard)
                left = (variance.view(groups, -1) - noise[at]).clamp_min(TINY_DB2)
                scale = (left / signal.diagonal(0, 1, 2).clamp_min(TINY_DB2)).sqrt()
                block = scale[:, :, None] * signal * scale[:, None] + noise[at].diag()
            covariance[:, at[:, None], at] = block
        return JointLevels(mean, covariance, noise)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """See `ClosedForm`; of rows where something was heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, _ = self._require_posteriors()
        if self.links is not None and self.links.heard is not None:
            return self.links.left_out(rows)
        means, spreads, known = [], [], []
        for number, process in posterior.processes.items():
            asked = slice(None) if rows is None else np.isin(self.rows[number], rows)
            some = (process.extra == 0).nonzero()[:, 0][asked]
            error, variance = posterior.left_out(number, some)
            means.append(process.given_values()[some, 0] - error)
            spreads.append(variance)
            known.append(self.rows[number][asked])
        moments = linear_moments(torch.cat(means).float(), torch.cat(spreads).float())
        return LeftOutRows(torch.cat(known).numpy(), *moments)

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        heard = {str(number): prior.state() for number, prior in self.own.heard.items()}
        state: dict[str, Any] = {
            "places": torch.from_numpy(np.nan_to_num(self.places)),
            "nowhere": np.flatnonzero(np.isnan(self.places).any(1)).tolist(),
            "never": self.own.never.state(),
            "own": heard,
            "heard": self.heard.state(),
            "unheard": self.unheard.state(),
            "inflation": self.inflation,
            "seed": self.seed,
            "whole": self.whole,
            "rows": {str(number): rows for number, rows in self.rows.items()},
            "link_priors": to_plain(self.link_priors),
            "links": to_plain(self.links),
        }
        if self.posterior is not None and self.elsewhere is not None:
            state["processes"] = {
                str(n): process.state() for n, process in self.posterior.processes.items()
            }
            for name, shared in (("posterior", self.posterior), ("elsewhere", self.elsewhere)):
                state[name] = {"lower": shared.factor.lower, "mean": shared.mean}
        return state

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.places, self.seed = site, state["places"].numpy().copy(), int(state["seed"])
        # No place is no number, which no file holds; older files lack it.
        self.places[state.get("nowhere", [])] = np.nan
        never = Prior.read(state["never"])
        heard = {int(number): Prior.read(part) for number, part in state["own"].items()}
        self.own = StationPriors(never, heard)
        self.heard, self.unheard = (SharedTerms.read(state[name]) for name in ("heard", "unheard"))
        self.rows = {int(number): rows for number, rows in state["rows"].items()}
        self.inflation, self.whole = float(state["inflation"]), float(state["whole"])
        parts = (from_plain(state.get(name)) for name in ("link_priors", "links"))
        self.link_priors, self.links = parts
        if "processes" in state:
            processes = {
                int(number): Exact.read(part) for number, part in state["processes"].items()
            }
            weights = [
                (Factor(state[n]["lower"]), state[n]["mean"]) for n in ("posterior", "elsewhere")
            ]
            self.posterior = SharedTermsPosterior(processes, never, self.heard.columns, weights[0])
            self.elsewhere = self._unheard_posterior(weights[1])

    def _unheard_posterior(self, weights: tuple[Factor, Tensor]) -> SharedTermsPosterior:
        """What is said of stations that have no rows; of a network's, of a sector without pattern,
        too.
        """
        never, network = self.own.never, self.network
        never = never if network is None else replace(never, trend=network.add_sectors(ROUND))
        return SharedTermsPosterior({}, never, self.unheard.columns, weights)

    def add_station(
        self, place: np.ndarray, sectors: Tensor, like: int | None = None
    ) -> JointPowerField:
        """Return one that knows k further stations, of no rows, as its last.

        Args:
            place: (3,) local [m].
            sectors: (k, 5) of a network, see `Sectors.table`; of others azimuths are -1.
            like: station of their band, in a network; None: of the first.

        Raises:
            DataError: azimuths or another's band, and this is no network.
            ValueError: before `condition`.
        """
        _, elsewhere = self._require_posteriors()
        result, network = copy(self), self.network
        result.places = np.concatenate([self.places, np.tile(place, (len(sectors), 1))])
        if network is None and (sectors[:, 0] != NO_AZIMUTH).any():
            raise DataError("azimuths of a new station: this model was learned without azimuths")
        if network is None and like is not None:
            raise DataError(
                "antenna.carrier_hz: this model was learned without azimuths, and tells no bands "
                "apart"
            )
        if network is not None:
            never = replace(self.own.never, trend=network.add_sectors(sectors, like))
            result.own = replace(self.own, never=never)
        result.elsewhere = result._unheard_posterior((elsewhere.factor, elsewhere.mean))
        return result

    @property
    def linked_stations(self) -> list[int] | None:
        """Numbers of stations with rows; None where it has no links."""
        return None if self.links is None else [*self.rows]

    def add_links(self, rows: PowerRows) -> JointPowerField:
        """Return one that knows rows of stations without any, too, listed or not.

        Args:
            rows: see `Links.add`.

        Raises:
            ValueError: it has no links.
        """
        links = self.require_fitted(self.links)
        result, new = copy(self), torch.from_numpy(np.unique(rows.places[:, 3:], axis=0))
        listed = stations_at(torch.from_numpy(self.places), new) != NOBODY
        result.places = np.concatenate([self.places, new[~listed]])
        numbers = stations_at(torch.from_numpy(result.places), new).tolist()
        result.rows = self.rows | dict.fromkeys(numbers, links.index[:0])
        result.links = links.add(rows)
        return result

    @property
    def _heard(self) -> list[int]:
        """Numbers of stations that answer by rows of their own."""
        posterior, _ = self._require_posteriors()
        by_links = self.links is not None and self.links.heard is not None
        return [*(self.rows if by_links else posterior.processes)]

    def _require_posteriors(self) -> tuple[SharedTermsPosterior, SharedTermsPosterior]:
        return self.require_fitted(self.posterior), self.require_fitted(self.elsewhere)

    def _places_and_stations(self, query: Query) -> tuple[Tensor, Tensor]:
        """Places (B, 6) of the moving end and the station, float64 [m], and its number (B,)."""
        ends, table = Ends.from_query(self.site, query), torch.from_numpy(self.places)
        moving, still, number = ends.moving, ends.still, ends.station
        if query.station is not None:
            still = torch.where(number[:, None] >= 0, table[number.clamp_min(0)], still)
            return torch.cat([moving, still], 1), number
        station_of_still, station_of_moving = (
            stations_at(table, place) for place in (still, moving)
        )
        turned = (station_of_still < 0) & (station_of_moving >= 0)  # asked the other way round
        swapped = torch.where(
            turned[:, None], torch.cat([still, moving], 1), torch.cat([moving, still], 1)
        )
        return swapped, torch.where(turned, station_of_moving, station_of_still)

    def _process_places(self, places: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
        """Places (B, 6), of a network (B, 7), and stations (B,) as processes have them."""
        if self.network is None:
            return places, number
        site = self.network.site[number.clamp_min(0)]
        # The last, without a pattern
        sector = torch.where(number < 0, len(self.network.table), number)
        return torch.cat([places, sector[:, None]], 1), torch.where(number < 0, NOBODY, site)

    def _law_share(self, moving: Tensor) -> Tensor:
        """Share (B,) of the variance that the law explains and places (B, 3)
        are too far to be sure of.

        Its slope says nothing of places far from all data.
        """
        if self._reach is None:
            posterior, _ = self._require_posteriors()
            places = torch.cat(
                [first_end(process.rows) for process in posterior.processes.values()]
            ).numpy()
            self._reach = (
                cKDTree(places),
                max(REACH * float(np.linalg.norm(np.ptp(places, axis=0))), TINY_M),
            )
        tree, reach = self._reach
        far = nearest_distance(tree, moving)
        law = max(1 - self.own.variance / self.whole, 0.0)
        return law * (1 - (-(far / reach).square()).exp())


def rows_per_station(stations: int) -> int:
    """Return rows of each station whose factors fit into memory together."""
    return min(MOST_ROWS, int(math.sqrt(MEMORY / torch.float64.itemsize / stations)))
