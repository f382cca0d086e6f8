"""The field of received powers: what the path loses in known walls, and a process of the rest.

In decibels: a constant or a distance law, uncertain; a loss for each known wall on the straight
path between the ends; one or two Matern-3/2 of place; noise. Of many rows the mean of such
processes is taken, by what squares left out say.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsparc.base.errors import Caution
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.walls import SceneWalls
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.image_sources.known.images import walls_in_frame
from gsparc.models.method import Prediction
from gsparc.models.powers.members import learn_members, weigh_members
from gsparc.models.powers.own_terms import UserTerm, describe_weights
from gsparc.models.powers.prior_map import PriorMap
from gsparc.models.target_rows import linear_moments, power_rows
from gsparc.processes.nearest import Nearest
from gsparc.processes.posterior import Exact, approximation_label
from gsparc.processes.powers import PowerProcess, PowerRows, condition_on_powers
from gsparc.processes.prior import Prior
from gsparc.processes.shared import QUERIES
from gsparc.processes.stored import from_plain, to_plain
from gsparc.processes.term import Columns
from gsparc.processes.trend import Trend
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort
from gsparc.training.stopwatch import Stopwatch

WALL_DB = 10.0  # deviation of the loss in a wall before any row
LEFT_OUT = "model.prior: the map is left out: rows left out are predicted as well without it"


class PowerField(ClosedForm):
    """Powers of one station, (1,) linear, by settings of the largest left-out likelihood.

    Args:
        seed: of rows that are drawn.
        walls: that are known, in the coordinates of the measurements.
        terms: further columns of the mean, in the coordinates of the measurements.
    """

    name = "process of powers"
    forgets = True
    site: Site
    priors: tuple[tuple[float, Prior], ...]  # with shares of the mean, the largest first

    def __init__(
        self,
        seed: int = 0,
        walls: SceneWalls | None = None,
        terms: tuple[Columns, ...] = (),
    ) -> None:
        self.seed, self.walls, self.own_terms = seed, walls, terms
        self.powers: PowerProcess | None = None
        self.known = np.zeros(0, np.int64)
        # Places of the process that known rows are of, where rows share them
        self.at = np.zeros(0, np.int64)
        self.decibels = np.zeros(0)

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose settings by training and validation rows, and condition on these.

        Raises:
            ValueError: no rows.
        """
        watch, rows = Stopwatch(), fold.learned()
        if not len(rows):
            raise ValueError("a process of powers needs at least one row")
        self.site = data.site
        notes = (
            *self._choose_priors(data, rows, context.counts),
            *self._judge_maps(power_rows(data, rows)),
        )
        self.condition(data, rows)
        user_terms = tuple(term for term in self.trend.more if isinstance(term, UserTerm))
        if user_terms and self.powers is not None and isinstance(self.powers.posterior, Exact):
            notes = (*describe_weights(self.powers.posterior, user_terms), *notes)
        return FitReport(watch.seconds, notes)

    def _choose_priors(
        self, data: Measurements, rows: np.ndarray, effort: Effort
    ) -> tuple[str, ...]:
        """Set the priors; what must be said of them."""
        seen, site, chosen_on = power_rows(data, rows), data.site, effort.chosen_on // 2
        # Checked once: a query has no time for it, nor has `torch.func`.
        terms = tuple(
            UserTerm.from_site(t, site).centre(torch.from_numpy(seen.places))
            for t in self.own_terms
        )
        walls, about = tuple[Columns, ...](), list[str]()
        if self.walls is not None:
            known = walls_in_frame(self.walls, site.origin, site.static_position)
            walls = (replace(known, loss_db=WALL_DB),)
            about.append(f"losses in {len(known.sizes)} known walls and floors")
        members = learn_members(seen, site, self.seed, chosen_on, terms, walls)
        self.priors, notes = weigh_members(seen, members, self.seed, chosen_on)
        return (*about, *notes)

    def _used_maps(self) -> list[PriorMap]:
        """Maps from before that the mean has a share of."""
        terms = [part for _, prior in self.priors for part in prior.known_trend.more]
        own = [part.term for part in terms if isinstance(part, UserTerm)]
        return [term for term in own if isinstance(term, PriorMap)]

    def _judge_maps(self, rows: PowerRows) -> list[Caution]:
        """What must be said of maps from before: that one is left out,
        and what may be wrong with it.
        """
        heard = rows.heard_rows
        used, cautions = self._used_maps(), list[Caution]()
        for term in self.own_terms:
            if isinstance(term, PriorMap):
                unused = "" if used else LEFT_OUT
                fault = term.explain_misfit(heard.places + self.site.origin, heard.decibels)
                cautions += [Caution(text) for text in (unused, fault) if text]
        return cautions

    @property
    def trend(self) -> Trend:
        """The mean law of the first prior."""
        return self.priors[0][1].known_trend

    @property
    def label(self) -> str:
        """The name, and how many nearest rows tell of a place where not all do."""
        return approximation_label(
            self.name, None if self.powers is None else self.powers.posterior
        )

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return self.powers

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` where walls are known, `residual` always."""
        return ("power", "residual") if self.trend.more else ("residual",)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; what rows say where nothing was heard is
        that powers are below a level.
        """
        seen = power_rows(data, rows)
        each = [
            (share, condition_on_powers(seen, prior, self.seed)[0]) for share, prior in self.priors
        ]
        self.powers = replace(each[0][1], others=tuple(each[1:]))
        loud = seen.subset(np.flatnonzero(~seen.silent))
        self.known, self.decibels = rows[~seen.silent], loud.decibels
        if isinstance(nearest := self.powers.posterior, Nearest):
            # A silent row may lie at the same place; its noise is larger than any mean's.
            heard = np.flatnonzero(nearest.noise.numpy() <= self.powers.kernel.noise)
            self.at = heard[cKDTree(self.powers.places[heard]).query(loud.places)[1]]

    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; (B, 1) linear powers.

        Raises:
            ValueError: before `condition`.
        """
        process, places = self.require_fitted(self.powers), query.places(self.site)
        parts = [process.answer(part) for part in places.split(QUERIES)]
        joined = (torch.cat(part).to(query.tx.dtype) for part in zip(*parts, strict=True))
        mean, spread, share = joined
        return Prediction(*linear_moments(mean, spread), share)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """See `ClosedForm`; of rows where something was heard.

        Of very many rows each is predicted without all that was measured at its place.

        Raises:
            ValueError: before `condition`.
        """
        process = self.require_fitted(self.powers)
        some = None if rows is None else np.flatnonzero(np.isin(self.known, rows))
        decibels, spread = process.left_out(self.at, some)
        known = self.known if some is None else self.known[some]
        return LeftOutRows(known, *linear_moments(decibels.float(), spread.float()))

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {
            "priors": to_plain(self.priors),
            "seed": self.seed,
            "known": torch.from_numpy(self.known),
            "at": torch.from_numpy(self.at),
            "decibels": torch.from_numpy(self.decibels),
            "process": to_plain(self.powers),
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.seed = site, int(state["seed"])
        if state.get("fringes") is not None:
            raise ValueError(
                "a model of powers with coherent waves is of an older program: train again"
            )
        self.priors, self.powers = (from_plain(state[name]) for name in ("priors", "process"))
        self.known, self.decibels, self.at = (
            state[name].numpy() for name in ("known", "decibels", "at")
        )
