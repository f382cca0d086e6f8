"""The field of powers of many ends: a law and a place term of the site, a process of each end.

Stations that were heard answer by their own process about the law of the site. A station that was never
heard is answered by the law and a process of place that all stations share, as strong as stations that were
left out want it. Either end may be the station.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.models.conditional import ConditionalField, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.per_station import SAME_PLACE_M
from gsparc.models.powers.together.learning import Own, learn_own, learn_strength
from gsparc.models.powers.together.network import Network, by_site, learn_network, network_of
from gsparc.models.powers.together.terms import Terms, link_rows, places_of
from gsparc.models.target_rows import entry_variance, from_real
from gsparc.processes.factor import Factor
from gsparc.processes.neighbourhood import nearest_distance
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import REACH
from gsparc.processes.prior import Prior
from gsparc.processes.shared import Shared
from gsparc.training.time_budget import TimeBudget

NEVER = -1  # in place of a station's number: one that was never heard
QUERIES = 512  # at a time: memory
MOST_EACH = 6_000  # rows of a station
MEMORY = 3e9  # bytes of all stations' factors
PLACES = 600  # that the shared process is known at in the end
UNHEARD_EACH = 1_000  # rows of each station, for what is said of others


class JointPowerField(ConditionalField):
    """See `ConditionalField`; targets are linear powers (1,).

    Args:
        site: of powers, with several stations.
        places: (T, 3) float64 of the stations [m].
        own: of the stations' own processes.
        heard: shared terms for stations that have rows.
        unheard: those for all others.
        inflation: of their variances.
        seed: of rows drawn.
        network: whose sectors have processes that those of a site share; None: each station has its own.
    """

    kind = "joint_powers"

    def __init__(
        self,
        site: Site,
        places: np.ndarray,
        own: Own,
        heard: Terms,
        unheard: Terms,
        inflation: float = 1.0,
        seed: int = 0,
        network: Network | None = None,
    ) -> None:
        self.site, self.places, self.own, self.seed, self.network = site, places, own, seed, network
        self.heard, self.unheard, self.inflation = heard, unheard, inflation
        self.posterior: Shared | None = None
        self.elsewhere: Shared | None = None
        self.whole = 1.0  # variance of what was measured, of all stations [dB^2]
        self.rows: dict[int, Tensor] = {}  # of what was heard of each station
        self._reach: tuple[cKDTree, float] | None = None  # of what is known, made when it is asked

    @property
    def count(self) -> int:
        """None."""
        return 0

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` always: its law is of the site."""
        return ("power", "residual")

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; silent rows say that powers are below a level."""
        every = link_rows(data, rows, self.places)
        every = every if self.network is None else by_site(every, self.network)
        used = every.thinned(most_each(len(every.stations)), self.seed)
        few = used.thinned(UNHEARD_EACH, self.seed)
        self.posterior, self._reach = self.own.given(used, self.heard, self.seed), None
        elsewhere = self.own.given(few, self.unheard, self.seed)
        self.elsewhere = Shared({}, self.own.never, self.unheard.columns, (elsewhere.factor, elsewhere.mean))
        loud = used if used.silent.all() else used.loud
        self.whole = max(float(loud.decibels.var()), self.own.variance)
        self.rows = {number: torch.from_numpy(used.of(number).loud.index) for number in used.stations}

    def __call__(self, query: Query) -> Prediction:
        """See `ConditionalField`; (B, 1) linear powers.

        Without stations, who stands at either end is asked; a negative one was never heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, elsewhere = self._conditioned()
        places, number = self._ends(query)
        if self.network is not None:
            places = torch.cat([places, number[:, None].clamp_min(0)], 1)
            number = torch.where(number < 0, NEVER, torch.from_numpy(self.network.site)[number.clamp_min(0)])
        mean, spread, share = (torch.zeros(len(places), dtype=torch.float64) for _ in range(3))
        for one in number.unique().tolist():
            of, inflation = (posterior, 1.0) if one in posterior.processes else (elsewhere, self.inflation)
            for chosen in torch.nonzero(number == one)[:, 0].split(QUERIES):
                mean[chosen], left = of.answer(places[chosen], one)
                spread[chosen], share[chosen] = inflation * left, left / self.whole
        share = (share + self._by_law(places[:, :3])).clamp_max(1.0)
        mean, spread, share = (part.to(query.tx.dtype) for part in (mean, spread, share))
        power = self._power(mean)
        return Prediction(power, entry_variance(spread, power, "rssi"), share)

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of rows where something was heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, _ = self._conditioned()
        means, spreads = [], []
        for number, process in posterior.processes.items():
            error, variance = posterior.left_out(number)
            loud = process.extra == 0
            means.append((process.values()[:, 0] - error)[loud])
            spreads.append(variance[loud])
        mean = self._power(torch.cat(means).float())
        variance = entry_variance(torch.cat(spreads).float(), mean, "rssi")
        return LeftOutRows(torch.cat([*self.rows.values()]).numpy(), mean, variance)

    def state(self) -> dict[str, Any]:
        """See `ConditionalField`."""
        heard = {str(number): prior.state() for number, prior in self.own.heard.items()}
        state: dict[str, Any] = {
            "places": torch.from_numpy(self.places), "never": self.own.never.state(), "own": heard,
            "heard": self.heard.state(), "unheard": self.unheard.state(), "inflation": self.inflation,
            "seed": self.seed, "whole": self.whole,
            "network": {} if self.network is None else self.network.state(),
            "rows": {str(number): rows for number, rows in self.rows.items()},
        }  # fmt: skip
        if self.posterior is not None and self.elsewhere is not None:
            state["processes"] = {str(n): one.state() for n, one in self.posterior.processes.items()}
            for name, one in (("posterior", self.posterior), ("elsewhere", self.elsewhere)):
                state[name] = {"lower": one.factor.lower, "mean": one.mean}
        return state

    def _conditioned(self) -> tuple[Shared, Shared]:
        if self.posterior is None or self.elsewhere is None:
            raise ValueError("a field of powers: condition it first")
        return self.posterior, self.elsewhere

    def _ends(self, query: Query) -> tuple[Tensor, Tensor]:
        """Places (B, 6) of the moving end and the station, float64 [m], and its number (B,)."""
        sender = query.tx.cpu().double()
        receiver = query.rx.position.reshape(-1, 3).expand(len(query), 3).cpu().double()
        moving, still = (sender, receiver) if self.site.static_end == "rx" else (receiver, sender)
        table = torch.from_numpy(self.places)
        if query.station is not None:
            number = query.station.cpu().long()
            still = torch.where(number[:, None] >= 0, table[number.clamp_min(0)], still)
            return torch.cat([moving, still], 1), number
        number = self._standing(still)
        turned = (number < 0) & (self._standing(moving) >= 0)  # asked the other way round
        here, there = torch.cat([moving, still], 1), torch.cat([still, moving], 1)
        places = torch.where(turned[:, None], there, here)
        return places, self._standing(places[:, 3:])

    def _by_law(self, moving: Tensor) -> Tensor:
        """Share (B,) of the variance that the law explains and places (B, 3) are too far to be sure of.

        Its slope says nothing of places far from all data.
        """
        if self._reach is None:
            posterior, _ = self._conditioned()
            known = torch.cat([one.rows[:, :3] for one in posterior.processes.values()]).numpy()
            self._reach = cKDTree(known), max(REACH * float(np.linalg.norm(np.ptp(known, axis=0))), 1e-9)
        tree, reach = self._reach
        far = nearest_distance(tree, moving)
        law = max(1 - self.own.variance / self.whole, 0.0)
        return law * (1 - (-(far / reach).square()).exp())

    def _standing(self, places: Tensor) -> Tensor:
        """Numbers (B,) of the stations at places (B, 3), negative where none stands."""
        apart, number = torch.cdist(places.detach(), torch.from_numpy(self.places).nan_to_num(math.inf)).min(
            1
        )
        return torch.where(apart <= SAME_PLACE_M, number, NEVER)

    def _power(self, decibels: Tensor) -> Tensor:
        return from_real(decibels[:, None], "rssi", (1,))


def most_each(stations: int) -> int:
    """Rows of each station whose factors fit into memory together."""
    return min(MOST_EACH, int(math.sqrt(MEMORY / 8 / stations)))


def initialise(
    data: Measurements,
    rows: np.ndarray,
    shared: bool = True,
    seed: int = 0,
    budget: TimeBudget | None = None,
) -> tuple[JointPowerField, tuple[str, ...]]:
    """A field of powers of all stations and what must be said of it; `condition` is to follow.

    Args:
        data: powers of several stations.
        rows: (n,) to learn from, at least one.
        shared: whether there may be any beside the law.
        seed: of rows and places that are drawn.
        budget: settings are not learned beyond it.

    Raises:
        ValueError: not several stations, or no rows.
    """
    if data.site.stations is None or len(data.site.stations) < 2:
        raise ValueError("a field of powers of many ends needs several stations")
    if not len(rows):
        raise ValueError("a field of powers needs at least one row")
    places, notes = places_of(data, rows)
    every = link_rows(data, rows, places)
    network = network_of(data, places)
    if network is None:
        own, remarks = learn_own(every, seed, budget)
    else:
        every = by_site(every, network)
        prior, remarks = learn_network(every, network, data.site.stations.name, seed, budget)
        own = Own(prior, {})
    most, largest = most_each(len(every.stations)), int(np.bincount(every.station).max())
    if largest > most:
        remarks.append(f"at most {most} rows of each station are learned from, of up to {largest}")
    assert own.never.trend is not None
    plain = Terms.over(every, own.never.trend, 1.0, 0, seed)
    field = JointPowerField(data.site, places, own, plain, plain, 1.0, seed, network)
    if not shared or network is not None:
        return field, (*notes, *remarks)
    terms, field.inflation, gain = learn_strength(every, own, seed, budget)
    if gain is None:
        remarks.append("no shared terms: too few stations to leave some out")
        return field, (*notes, *remarks)
    before, after = math.sqrt(gain.others), math.sqrt(max(gain.others - gain.squares, 0.0))
    remarks.append(
        f"stations left out, after one constant: rmse {before:.3g} dB without shared terms, {after:.3g} dB "
        f"with them (gain {gain.squares:.2g} +- {gain.error:.2g} dB^2)"
    )
    if terms.place_db:
        field.unheard = terms.known_at(every, PLACES, seed)
    return field, (*notes, *remarks)


def restored(site: Site, state: dict[str, Any]) -> JointPowerField:
    """The field whose `state()` this was."""
    never = Prior.read(state["never"])
    assert never.trend is not None
    own = Own(never, {int(number): Prior.read(part) for number, part in state["own"].items()})
    heard, unheard = (Terms.read(never.trend, state[name]) for name in ("heard", "unheard"))
    stored = {name: value.numpy() for name, value in state.get("network", {}).items()}
    network = Network(**stored) if stored else None
    field = JointPowerField(
        site,
        state["places"].numpy(),
        own,
        heard,
        unheard,
        float(state["inflation"]),
        int(state["seed"]),
        network,
    )
    field.rows = {int(number): rows for number, rows in state["rows"].items()}
    field.whole = float(state["whole"])
    if "processes" in state:
        processes = {int(number): Exact.read(part) for number, part in state["processes"].items()}
        weights = [(Factor(state[n]["lower"]), state[n]["mean"]) for n in ("posterior", "elsewhere")]
        field.posterior = Shared(processes, never, heard.columns, weights[0])
        field.elsewhere = Shared({}, never, unheard.columns, weights[1])
    return field
