"""The field of received powers: what the path loses in known walls, and a process of the rest.

In decibels: a constant or a distance law, uncertain; a loss for each known wall on the straight path between
the ends; one or two Matern-3/2 of place; noise. Of many rows the mean of such processes is taken, by what
squares left out say. Where a wavelength is sampled powers interfere: there coherent waves stand beside one
process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.models.baselines.distance_law import law_of
from gsparc.models.conditional import ConditionalField, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.powers.fringes import Fringes, find_fringes, fringes_of, nearest, sampled
from gsparc.models.powers.settings import candidates, chosen_among, mixture
from gsparc.models.target_rows import entry_variance, from_real, rows_of
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import Nearest
from gsparc.processes.neighbourhood import nearest_distance
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerProcess, Rows, conditioned, trend_of_rows
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Trend, Walls, trend_of
from gsparc.training.time_budget import Effort, TimeBudget

QUERIES = 512  # at a time: memory


class PowerField(ConditionalField):
    """See `ConditionalField`; targets are linear powers (1,). Settings have the largest left-out likelihood.

    Args:
        site: of powers, with at most one end that stands.
        trend: the mean law.
        kernel: of the process.
        seed: of rows drawn where there are too many.
        fringes: of coherent waves, beside the process.
        others: further priors with their shares in the mean; the rest is that of trend and kernel.
    """

    kind = "powers"

    def __init__(
        self,
        site: Site,
        trend: Trend,
        kernel: Kernel,
        seed: int = 0,
        fringes: Fringes | None = None,
        others: Sequence[tuple[float, Prior]] = (),
    ) -> None:
        self.fringes, self.others = fringes, tuple(others)
        self.site, self.trend, self.kernel, self.seed = site, trend, kernel, seed
        self.process: PowerProcess | None = None
        self._tree: cKDTree | None = None  # of its places, made when it is asked
        self.known = np.zeros(0, np.int64)
        self.at = np.zeros(0, np.int64)  # places of the process that known rows are of, where rows share them
        self.decibels = np.zeros(0)

    @property
    def count(self) -> int:
        """See `ConditionalField`; coherent waves count as Gaussians of no extent, far away."""
        return 0 if self.fringes is None else len(self.fringes.weights)

    @property
    def forgets(self) -> bool:
        """See `ConditionalField`; coherent waves keep what they were fitted to."""
        return self.fringes is None

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` where walls are known, `phase` where coherent waves are, `residual` always."""
        named = {"power": self.trend.walls is not None, "phase": self.fringes is not None, "residual": True}
        return tuple(name for name, there in named.items() if there)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; what rows say where nothing was heard is that powers are below a level."""
        seen = rows_of(data, rows)
        first = Prior(self.kernel, self.trend)
        own, *others = (_given(seen, prior, self.seed) for prior in (first, *(one for _, one in self.others)))
        shares = (share for share, _ in self.others)
        self.process = replace(own, others=tuple(zip(shares, others, strict=True)))
        self._tree = None
        loud = seen.at(np.flatnonzero(~seen.silent))
        self.known, self.decibels = rows[~seen.silent], loud.decibels
        if isinstance(nearest := self.process.posterior, Nearest):
            # A silent row may lie at the same place; its noise is larger than any mean's.
            heard = np.flatnonzero(nearest.noise.numpy() <= self.process.kernel.noise)
            self.at = heard[cKDTree(self.process.places[heard]).query(loud.places)[1]]

    def __call__(self, query: Query) -> Prediction:
        """See `ConditionalField`; (B, 1) linear powers.

        Raises:
            ValueError: before `condition`.
        """
        process, places = self._conditioned(), query.places(self.site)
        parts = [self._answer(process, part) for part in places.split(QUERIES)]
        mean, spread, share, explained = (torch.cat(part) for part in zip(*parts, strict=True))
        mean, spread, share, explained = (
            part.to(query.tx.dtype) for part in (mean, spread, share, explained)
        )
        power = self._power(mean)
        explained_power = self._power(explained) if self.count else None
        return Prediction(power, entry_variance(spread, power, "rssi"), share, explained_power)

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of rows where something was heard.

        Of very many rows each is predicted without all that was measured at its place.

        Raises:
            ValueError: before `condition`.
        """
        process = self._conditioned()
        decibels, spread = process.left_out(self.at)
        if self.fringes is not None:
            posterior = process.posterior
            loud = (posterior.extra == 0).numpy() if isinstance(posterior, Exact) else self.at
            places = process.places[loud]
            decibels, factor = self.fringes.blended_unseen(
                decibels, torch.from_numpy(places), torch.from_numpy(nearest(places)), self.known
            )
            spread = spread * factor
        mean = self._power(decibels.float())
        return LeftOutRows(self.known, mean, entry_variance(spread.float(), mean, "rssi"))

    def state(self) -> dict[str, Any]:
        """See `ConditionalField`."""
        lengths, shares, kernel = (torch.tensor(part).double() for part in self.kernel.state().values())
        logit = (shares[0] / shares[1]).log() if len(shares) == 2 else torch.zeros(()).double()
        return {
            "log_lengths": lengths.log(),
            "share_logit": logit,
            "log_noise": kernel[0].log(),
            "log_amplitude": kernel[1].log(),
            **self.trend.state(),
            "seed": self.seed,
            "known": torch.from_numpy(self.known),
            "at": torch.from_numpy(self.at),
            "decibels": torch.from_numpy(self.decibels),
            "others": [{**prior.state(), "share": share} for share, prior in self.others],
            **({} if self.fringes is None else {"fringes": self.fringes.state()}),
            **({} if self.process is None else {"process": self.process.state()}),
        }

    def _answer(self, process: PowerProcess, places: Tensor) -> tuple[Tensor, ...]:
        """Mean [dB], its variance [dB^2], share of the prior's, and what is explained [dB], each (b,)."""
        mean, spread, share = process.answer(places)
        if self.fringes is None:
            return mean, spread, share, mean
        mean, factor = self.fringes.blended(mean, places, self._distance(places))
        return mean, spread * factor, share, self.fringes.solutions(places).mean(1)

    def _distance(self, places: Tensor) -> Tensor:
        """From the nearest known row (B,) [m]."""
        if self._tree is None:
            self._tree = cKDTree(self._conditioned().places)
        return nearest_distance(self._tree, places)

    def _conditioned(self) -> PowerProcess:
        if self.process is None:
            raise ValueError("a field of powers: condition it first")
        return self.process

    def _power(self, decibels: Tensor) -> Tensor:
        return from_real(decibels[:, None], "rssi", (1,))


def initialise(
    data: Measurements,
    rows: np.ndarray,
    fringes: bool = True,
    seed: int = 0,
    budget: TimeBudget | None = None,
    walls: Walls | None = None,
) -> tuple[PowerField, tuple[str, ...]]:
    """A field of powers and what must be said of it; `condition` is to follow.

    Args:
        data: powers, of one station where there are several.
        rows: (n,) to learn from, at least one.
        fringes: whether coherent waves are sought where neighbours are closer than half a wavelength.
        seed: of rows and waves that are drawn.
        budget: no waves are sought beyond it.
        walls: that are known; no waves are sought beside them.

    Raises:
        ValueError: no rows.
    """
    if not len(rows):
        raise ValueError("a field of powers needs at least one row")
    seen = rows_of(data, rows)
    waves = walls is None and fringes and not seen.silent.any() and sampled(seen.places, data.site.wavelength)
    chosen_on = (Effort() if budget is None else budget.effort).chosen_on
    if walls is not None:
        law, notes = law_of(seen, data.site)
        trend = replace(trend_of_rows(seen, law), walls=walls)
        best = chosen_among(seen, [(trend, 0.0, ())], seed, chosen_on)
        note = f"losses in {len(walls.sizes)} known walls and floors, about a distance law"
        return PowerField(data.site, trend, best.kernel, seed), (note, *notes, *best.notes)
    found, said = candidates(seen, data.site, seed, chosen_on), list[str]()
    if waves:
        order = np.argsort(rows)
        plain = found[0].trend, found[0].kernel
        assert data.site.wavelength is not None
        waved, note = find_fringes(seen.at(order), rows[order], plain, data.site.wavelength, seed, budget)
        said.append(note)
        if waved is not None:  # their share was learned beside this process
            notes = (found[0].description, *found[0].notes, note)
            return PowerField(data.site, *plain, seed, waved), notes
    ((_, first), *others), notes = mixture(seen, found, seed, chosen_on)
    assert isinstance(first.kernel, Kernel) and first.trend is not None
    return PowerField(data.site, first.trend, first.kernel, seed, None, others), (*notes, *said)


def _given(rows: Rows, prior: Prior, seed: int) -> PowerProcess:
    assert isinstance(prior.kernel, Kernel) and prior.trend is not None
    return conditioned(rows, prior.trend, prior.kernel, seed)[0]


def restored(site: Site, state: dict[str, Any]) -> PowerField:
    """The field whose `state()` this was."""
    logit = [state["share_logit"][None]] if len(state["log_lengths"]) == 2 else []
    settings = torch.cat([state["log_lengths"], *logit, state["log_noise"][None]]).double()
    kernel = Kernel.of(settings.numpy(), math.exp(state["log_amplitude"]))
    fringes = fringes_of(state["fringes"]) if "fringes" in state else None
    others = [(float(one["share"]), Prior.read(one)) for one in state.get("others", ())]
    field = PowerField(site, trend_of(state), kernel, int(state["seed"]), fringes, others)
    field.known, field.decibels = state["known"].numpy(), state["decibels"].numpy()
    field.at = state["at"].numpy()
    if "process" in state:
        field.process = PowerProcess.read(state["process"])
    return field
