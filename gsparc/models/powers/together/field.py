"""The field of powers of many ends: a law, Gaussians and a place term of the site, a process of each end.

Stations that were heard answer by their own process about the site's law; shared terms stand beside it where
groups of places that were left out say so. A station that was never heard is answered by what the site
shares, as strong as stations that were left out want it. Either end may be the station.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.models.per_station import SAME_PLACE_M
from gsparc.models.powers.groups import Gain, compared, folds, groups
from gsparc.models.powers.together import posterior as joint
from gsparc.models.powers.together.law import fit_site_law
from gsparc.models.powers.together.learning import learn_ends, learn_shared, start, with_inducing
from gsparc.models.powers.together.posterior import NEVER, given, restored_posterior
from gsparc.models.powers.together.prior import Prior, restored_prior
from gsparc.models.powers.together.rows import Heard, heard_rows, is_together, places_of, thinned
from gsparc.models.powers.together.unheard import for_unheard
from gsparc.models.target_rows import TINY_POWER, entry_variance, from_real
from gsparc.ops import Pose
from gsparc.processes.powers import REACH
from gsparc.training.conditional import ConditionalField, LeftOutRows, Posterior
from gsparc.training.time_budget import TimeBudget

QUERIES = 512  # at a time: memory
MOST_EACH = 6_000  # rows of a station
MEMORY = 3e9  # bytes of all stations' factors
LEARNED_ON = 6_000  # rows of all stations, for settings that all have alike
LEARNED_EACH = 500
ENDS_FROM = 400  # rows that a station needs for settings of its own
ENDS_ON = 700
PLACES = 600  # that the shared process is known at in the end
UNHEARD_EACH = 1_000  # rows of each station, for what is said of others
COMPARED_EACH = 400  # the same, for asking whether shared terms pay where stations were heard
FOLDS = 5
SURER = 2.0  # with few rows of each station the others say more than with all of them


class JointPowerField(ConditionalField):
    """See `ConditionalField`; targets are linear powers (1,). Nothing in it moves with gradients.

    Args:
        site: of powers, with several stations.
        places: (T, 3) float64 of the stations [m].
        heard: the prior of stations that have rows.
        unheard: that of all others.
        inflation: of their variances.
        seed: of rows and places drawn.
    """

    kind = "joint_powers"
    reads_rows = True

    def __init__(
        self,
        site: Site,
        places: np.ndarray,
        heard: Prior,
        unheard: Prior,
        inflation: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.site, self.places, self.seed = site, places, seed
        self.heard, self.unheard, self.inflation = heard, unheard, inflation
        self.posterior: joint.Posterior | None = None
        self.elsewhere: joint.Posterior | None = None
        self._reach: tuple[cKDTree, float] | None = None  # of what is known, made when it is asked
        self.rows: dict[int, np.ndarray] = {}
        self.decibels: dict[int, np.ndarray] = {}

    @property
    def count(self) -> int:
        """Gaussians in the way to stations that were heard."""
        return len(self.heard.blockers)

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` always: its law is of the site."""
        return ("power", "residual")

    def objects(self) -> SiteObjects:
        """Gaussians that all stations are seen through, else those that stations never heard would be."""
        for posterior in (one for one in (self.posterior, self.elsewhere) if one is not None):
            means, scales, turns = (part.numpy() for part in vars(posterior.prior.blockers).values())
            if len(means):
                first = len(posterior.prior.inducing)
                deviation = math.exp(0.5 * posterior.prior.log_cloud.item())
                losses = -deviation * posterior.mean[first : first + len(means)].numpy()
                return SiteObjects.of(gaussians=(means, np.exp(scales), turns, losses))
        return SiteObjects.of()

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; silent rows say that powers are below a level.

        Raises:
            ValueError: no rows.
        """
        if not len(rows):
            raise ValueError("a field of powers needs at least one row")
        every = heard_rows(data, rows, self.places)
        used = thinned(every, most_each(len(every.stations)), self.seed)
        (self.posterior, _, kept), self._reach = given(used, self.heard), None
        loud = [used.at(own[~used.silent[own]]) for own in kept]
        self.rows = {int(used.station[own[0]]): part.rows for own, part in zip(kept, loud, strict=True)}
        self.decibels = {
            int(used.station[own[0]]): part.decibels for own, part in zip(kept, loud, strict=True)
        }
        few = thinned(every, UNHEARD_EACH, self.seed)
        self.elsewhere = given(few, self.unheard)[0].shared_alone()

    @torch.no_grad()
    def forward(self, tx: Tensor, rx: Pose, station: Tensor | None = None) -> Posterior:
        """See `ConditionalField`; (B, 1) linear powers.

        Args:
            tx: (B, 3) [m].
            rx: one shared or B receiver poses.
            station: (B,) int64, or None: who stands at either end; negative was never heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, elsewhere = self._conditioned()
        moving, still, number = self._asked(tx, rx, station)
        parts = torch.zeros(4, len(moving), dtype=torch.float64)
        for one in number.unique().tolist():
            known = one in posterior.ends
            for chosen in torch.nonzero(number == one)[:, 0].split(QUERIES):
                of = posterior if known else elsewhere
                said = torch.stack(of.answer(moving[chosen], still[chosen], one if known else NEVER))
                said[1] *= 1.0 if known else self.inflation
                parts[:, chosen] = said
        mean, spread, share, explained = parts
        share = (share + self._by_law(moving)).clamp_max(1.0)
        power = self._power(mean)
        variance = entry_variance(spread.float(), power, "rssi")
        return Posterior(power, variance, self._power(explained) if self.count else None, share.float())

    def answer(self, batch: Batch) -> Posterior:
        """See `ConditionalField`; two stations may stand at one place."""
        return self.forward(batch.tx, batch.rx, batch.station)

    def loss(self, batch: Batch) -> Tensor:
        """See `ConditionalField`; rows that were not measured cost 0."""
        losses = torch.zeros(len(batch), dtype=torch.float64)
        used = torch.ones(len(batch), dtype=torch.bool)
        if batch.mask is not None:
            used = batch.mask.flatten(1).all(1)
        if not used.any():
            return losses
        moving, still, number = self._asked(batch.tx, batch.rx, batch.station)
        decibels = 10 * batch.target.flatten(1)[:, 0].double().clamp_min(TINY_POWER).log10()
        order = torch.nonzero(used)[:, 0].numpy()
        ends = moving.numpy()[order], still.numpy()[order], number.numpy()[order]
        rows = Heard(*ends, decibels.numpy()[order], ~used.numpy()[order], order)
        posterior, _, kept = given(rows, self.heard)
        for own, (error, variance) in zip(kept, posterior.left_out().values(), strict=True):
            density = 0.5 * (error.square() / variance + variance.log() + math.log(2 * math.pi))
            losses[torch.from_numpy(rows.rows[own])] = density
        return losses

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of rows where something was heard.

        Raises:
            ValueError: before `condition`.
        """
        posterior, _ = self._conditioned()
        rows, means, spreads = [], [], []
        for number, (error, variance) in posterior.left_out().items():
            rows.append(self.rows[number])
            means.append(torch.from_numpy(self.decibels[number]) - error)
            spreads.append(variance)
        mean = self._power(torch.cat(means))
        return LeftOutRows(
            np.concatenate(rows), mean, entry_variance(torch.cat(spreads).float(), mean, "rssi")
        )

    def state(self) -> dict[str, Any]:
        """See `ConditionalField`."""
        state: dict[str, Any] = {
            "places": torch.from_numpy(self.places), "heard": self.heard.state(),
            "unheard": self.unheard.state(), "inflation": self.inflation, "seed": self.seed,
            "rows": {str(number): torch.from_numpy(rows) for number, rows in self.rows.items()},
            "decibels": {str(number): torch.from_numpy(part) for number, part in self.decibels.items()},
        }  # fmt: skip
        if self.posterior is not None and self.elsewhere is not None:
            state |= {"posterior": self.posterior.state(), "elsewhere": self.elsewhere.state()}
        return state

    def _conditioned(self) -> tuple[joint.Posterior, joint.Posterior]:
        if self.posterior is None or self.elsewhere is None:
            raise ValueError("a field of powers: condition it first")
        return self.posterior, self.elsewhere

    def _asked(self, tx: Tensor, rx: Pose, station: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Places (B, 3), (B, 3) of the moving end and the station, float64 [m], and its number (B,)."""
        sender = tx.cpu().double()
        receiver = rx.position.reshape(-1, 3).expand(len(tx), 3).cpu().double()
        moving, still = (sender, receiver) if self.site.static_end == "rx" else (receiver, sender)
        table = torch.from_numpy(self.places)
        if station is not None:
            number = station.cpu().long()
            return moving, torch.where(number[:, None] >= 0, table[number.clamp_min(0)], still), number
        number = self._standing(still)
        turned = (number < 0) & (self._standing(moving) >= 0)  # asked the other way round
        moving, still = (
            torch.where(turned[:, None], one, other) for one, other in ((still, moving), (moving, still))
        )
        return moving, still, self._standing(still)

    def _by_law(self, moving: Tensor) -> Tensor:
        """Share (B,) of the variance that the law explains and places (B, 3) are too far to be sure of.

        Its slope says nothing of places far from all data.
        """
        posterior, _ = self._conditioned()
        if self._reach is None:
            known = torch.cat([end.moving for end in posterior.ends.values()]).numpy()
            self._reach = cKDTree(known), max(REACH * float(np.linalg.norm(np.ptp(known, axis=0))), 1e-9)
        tree, reach = self._reach
        far = torch.from_numpy(tree.query(moving.numpy())[0])
        law = max(1 - float(posterior.prior.variance(NEVER)) / posterior.whole, 0.0)
        return law * (1 - (-(far / reach).square()).exp())

    def _standing(self, places: Tensor) -> Tensor:
        """Numbers (B,) of the stations at places (B, 3), negative where none stands."""
        apart, number = torch.cdist(places, torch.from_numpy(self.places).nan_to_num(math.inf)).min(1)
        return torch.where(apart <= SAME_PLACE_M, number, NEVER)

    def _power(self, decibels: Tensor) -> Tensor:
        return from_real(decibels[:, None].float(), "rssi", (1,))


def most_each(stations: int) -> int:
    """Rows of each station whose factors fit into memory together."""
    return min(MOST_EACH, int(math.sqrt(MEMORY / 8 / stations)))


def initialise(
    data: Measurements,
    rows: np.ndarray,
    sure: float = 1.0,
    shared: bool = True,
    seed: int = 0,
    budget: TimeBudget | None = None,
) -> tuple[JointPowerField, tuple[str, ...]]:
    """A field of powers of all stations and what must be said of it; `condition` is to follow.

    Args:
        data: powers of several stations.
        rows: (n,) to learn from, at least one.
        sure: standard errors that the gain of shared terms must exceed, at left-out places or stations.
        shared: whether there may be any beside the law.
        seed: of rows and places that are drawn.
        budget: settings are not learned beyond it.

    Raises:
        ValueError: not powers, not several stations, or no rows.
    """
    if data.site.kind != "rssi":
        raise ValueError(f"a field of powers needs received powers (rssi), not {data.site.kind}")
    if not is_together(data.site):
        raise ValueError("a field of powers of many ends needs several stations")
    if not len(rows):
        raise ValueError("a field of powers needs at least one row")
    places, notes = places_of(data, rows)
    every = heard_rows(data, rows, places)
    count = len(every.stations)
    law = fit_site_law(every)
    few = thinned(every, min(LEARNED_EACH, max(LEARNED_ON // count, 1)), seed)
    prior = start(few, law, len(places), seed)
    said = [
        f"{count} stations in one model, law of exponent {law.exponent:.3g} +- {law.exponents:.2g}, "
        f"levels +- {law.levels_db:.2g} dB"
    ]
    most, largest = most_each(count), int(np.bincount(every.station).max())
    if largest > most:
        said.append(f"at most {most} rows of each station are learned from, of up to {largest}")
    prior, _ = learn_shared(prior, few, budget=budget)
    if max(np.bincount(every.station)) >= ENDS_FROM and not (budget and budget.over(0.5)):
        many = thinned(every, ENDS_ON, seed)
        enough = np.flatnonzero(np.bincount(many.station, minlength=len(places)) >= ENDS_FROM)
        own = many.at(np.flatnonzero(np.isin(many.station, enough)))
        prior = learn_ends(prior, own, budget=budget)
        said.append(f"settings of their own for {len(enough)} stations")
    field = JointPowerField(data.site, places, prior, prior, 1.0, seed)
    if not shared:
        return field, (*notes, *said)
    unheard = for_unheard(every, prior, sure, seed, budget)
    field.inflation = unheard.inflation
    if unheard.gain is None:
        said.append("no shared terms: too few stations to leave some out")
        return field, (*notes, *said)
    said.append("stations left out, after one constant: " + _gain_text(unheard.gain, "shared terms"))
    strong = unheard.prior
    if not strong.columns:
        return field, (*notes, *said)
    field.unheard = with_inducing(strong, every, PLACES, seed) if len(strong.inducing) else strong
    at_places = None if budget and budget.over(0.8) else gain_of_places(every, prior, strong, seed)
    if at_places is None:
        said.append("no time to try shared terms on groups of places that are left out")
    else:
        said.append("groups of places left out: " + _gain_text(at_places, "shared terms"))
        if at_places.exceeds(SURER * sure):
            field.heard = field.unheard
    return field, (*notes, *said)


def gain_of_places(rows: Heard, without: Prior, strong: Prior, seed: int) -> Gain | None:
    """What shared terms gain at squares of floor that are left out for all stations."""
    few = thinned(rows, COMPARED_EACH, seed)
    group = groups(few.moving)
    errors: list[list[np.ndarray]] = [[], []]
    told = []
    for part in folds(group, FOLDS, seed):
        rest = np.setdiff1d(np.arange(len(group)), part)
        asked = part[~few.silent[part]]
        if not len(asked) or few.silent[rest].all():
            continue
        told.append(group[asked])
        for prior, errors_of in zip((without, strong), errors, strict=True):
            errors_of.append(_errors(few.at(rest), few.at(asked), prior))
    if not told:
        return None
    other, one = (np.concatenate(part) ** 2 for part in errors)
    return compared(one, other, np.concatenate(told))


def _errors(known: Heard, asked: Heard, prior: Prior) -> np.ndarray:
    """Of predictions at rows asked (n,) [dB]."""
    posterior, _, _ = given(known, prior)
    found = np.zeros(len(asked.rows))
    for number in asked.stations:
        own = np.flatnonzero(asked.station == number)
        ends = torch.from_numpy(asked.moving[own]), torch.from_numpy(asked.still[own])
        found[own] = posterior.mean_of(*ends, number).numpy() - asked.decibels[own]
    return found


def _gain_text(gain: Gain, what: str) -> str:
    before, after = math.sqrt(gain.others), math.sqrt(max(gain.others - gain.squares, 0.0))
    return (
        f"rmse {before:.3g} dB without {what}, {after:.3g} dB with them "
        f"(gain {gain.squares:.2g} +- {gain.error:.2g} dB^2)"
    )


def restored(site: Site, state: dict[str, Any]) -> JointPowerField:
    """The field whose `state()` this was."""
    heard, unheard = restored_prior(state["heard"]), restored_prior(state["unheard"])
    field = JointPowerField(
        site, state["places"].numpy(), heard, unheard, float(state["inflation"]), int(state["seed"])
    )
    field.rows = {int(number): rows.numpy() for number, rows in state["rows"].items()}
    field.decibels = {int(number): part.numpy() for number, part in state["decibels"].items()}
    if "posterior" in state:
        field.posterior = restored_posterior(state["posterior"])
        field.elsewhere = restored_posterior(state["elsewhere"])
    return field
