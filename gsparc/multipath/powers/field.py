"""The field of received powers: what the path loses in known walls, and a process of the rest.

In decibels: a constant or a distance law, uncertain; Gaussians for walls that the straight path between the
ends loses power in, their strengths a Gaussian prior; one or two Matern-3/2 of place; noise. Without walls it
is `model=gp`. Where a wavelength is sampled powers interfere: there coherent waves take the Gaussians' part.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.field.conditional import ConditionalField, LeftOutRows, Posterior
from gsparc.methods.censored import silent
from gsparc.methods.haste import haste
from gsparc.methods.power_settings import LAW_NEEDS, choose_about, choose_prior, fit_powers
from gsparc.methods.target_rows import TINY_POWER, entry_variance, from_real, to_real, training_targets
from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath.powers.blockers import Blockers, Place, ShadowedTrend
from gsparc.multipath.powers.fringes import Fringes, find_fringes, fringes_of, nearest, sampled
from gsparc.multipath.powers.groups import Gain, compared, folds, groups
from gsparc.multipath.powers.likelihood import Covariance, left_out_losses
from gsparc.ops import Pose
from gsparc.processes.covering import covering
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import Kernel
from gsparc.processes.nearest import COVER, Nearest
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerProcess, Rows, conditioned, draw
from gsparc.processes.trend import Trend, trend_of

QUERIES = 512  # at a time: memory
TRIED_ON = 600  # rows: each look factors a matrix
HASTY = 0.3  # of what is left, for each of the later ones
CHOOSING = 0.3  # of the seconds, for the settings of the plain process
FOLDS = 5
MOST_ASKED = 4_000  # rows of a fold that are predicted
SURE = 1.0  # standard errors that walls may lose at groups of places left out
RIDGE_STEPS = 5  # of the variance of what is left
LEAST = 12  # rows that were heard, for asking whether walls pay


class PowerField(ConditionalField):
    """See `ConditionalField`; parameters are float64, targets linear powers (1,).

    Args:
        site: of powers, with at most one end that stands.
        trend: the mean law.
        kernel: of the process.
        blockers: Gaussians, in units of the kernel's amplitude.
        still: of the end that stands [m]; None where both move or there are no Gaussians.
        seed: of rows drawn where there are too many.
        fringes: of coherent waves, beside the process; they do not move with gradients.

    Attributes:
        means, log_scales, turns, log_strengths: of N Gaussians, see `Blockers`.
        log_lengths, share_logit, log_noise, log_amplitude: of the process, see `Covariance`.
    """

    kind = "powers"

    def __init__(
        self,
        site: Site,
        trend: Trend,
        kernel: Kernel,
        blockers: Blockers,
        still: Place | None,
        seed: int = 0,
        fringes: Fringes | None = None,
    ) -> None:
        super().__init__()
        self.fringes = fringes
        self.site, self.trend, self.still, self.seed = site, trend, still, seed
        self.means, self.log_scales, self.turns, self.log_strengths = (
            nn.Parameter(part.clone()) for part in blockers.parts()
        )
        self.most = blockers.most
        covariance = Covariance.of(kernel)
        self.log_lengths, self.share_logit, self.log_noise, self.log_amplitude = (
            nn.Parameter(part) for part in vars(covariance).values()
        )
        self.process: PowerProcess | None = None
        self._tree: cKDTree | None = None  # of its places, made when it is asked
        self.known = np.zeros(0, np.int64)
        self.at = np.zeros(0, np.int64)  # places of the process that known rows are of, where rows share them
        self.decibels = np.zeros(0)
        self.alone = np.zeros(0)  # weights of the terms where there is no process

    @property
    def count(self) -> int:
        """See `ConditionalField`; coherent waves count as Gaussians of no extent, far away."""
        return len(self.means) + (0 if self.fringes is None else len(self.fringes.weights))

    @property
    def forgets(self) -> bool:
        """See `ConditionalField`; coherent waves keep what they were fitted to."""
        return self.fringes is None

    @property
    def terms(self) -> tuple[str, ...]:
        """`power` where Gaussians are, `phase` where coherent waves are, `residual` always."""
        named = {"power": len(self.means) > 0, "phase": self.fringes is not None, "residual": True}
        return tuple(name for name, there in named.items() if there)

    @property
    def blockers(self) -> Blockers:
        """The Gaussians as they are, with their gradients."""
        return Blockers(self.means, self.log_scales, self.turns, self.log_strengths, most=self.most)

    def objects(self) -> SiteObjects:
        """The Gaussians with the losses that rows say."""
        if not len(self.means):
            return SiteObjects.of()
        still = [part.detach() for part in self.blockers.parts()]
        losses = -self.alone[-len(self.means) :] * still[3].exp().numpy()
        return SiteObjects.of(gaussians=(still[0].numpy(), still[1].exp().numpy(), still[2].numpy(), losses))

    def prior(self) -> tuple[Trend, Kernel]:
        """What the parameters say, without gradients."""
        logit = [self.share_logit.item()] if len(self.log_lengths) == 2 else []
        settings = np.array([*self.log_lengths.tolist(), *logit, self.log_noise.item()])
        kernel = Kernel.of(settings, math.exp(self.log_amplitude.item()))
        if not len(self.means):
            return self.trend, kernel
        still = Blockers(*(part.detach().clone() for part in self.blockers.parts()), most=self.most)
        return ShadowedTrend.over(self.trend, still, self.still), kernel

    def loss(self, batch: Batch) -> Tensor:
        """See `ConditionalField`; of the process alone. Rows that were not measured cost 0."""
        losses = self.log_noise.new_zeros(len(batch))
        used = torch.ones(len(batch), dtype=torch.bool)
        if batch.mask is not None:
            used = batch.mask.flatten(1).all(1)
        places = self._places(batch.tx, batch.rx)[used]
        if not len(places):
            return losses + 0 * self.log_noise
        decibels = 10 * batch.target.flatten(1)[used, 0].double().clamp_min(TINY_POWER).log10()
        columns = self.trend.terms(places)
        if len(self.means):
            columns = torch.cat([columns, self.blockers.terms(places, self.still)], 1)
        distance = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
        covariance = Covariance(self.log_lengths, self.share_logit, self.log_noise, self.log_amplitude)
        gram, values = covariance.gram(distance, columns), decibels - self.trend.mean(places)
        return losses.index_put((used.nonzero()[:, 0],), left_out_losses(gram, values, self.log_amplitude))

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; what rows say where nothing was heard is that powers are below a level.

        Raises:
            ValueError: no rows.
        """
        if not len(rows):
            raise ValueError("a field of powers needs at least one row")
        seen = rows_of(data, rows)
        self.process, _ = conditioned(seen, *self.prior(), self.seed)
        self._tree = None
        loud = seen.at(np.flatnonzero(~seen.silent))
        self.known, self.decibels = rows[~seen.silent], loud.decibels
        if isinstance(nearest := self.process.posterior, Nearest):
            # A silent row may lie at the same place; its noise is larger than any mean's.
            heard = np.flatnonzero(nearest.noise.numpy() <= self.process.kernel.noise)
            self.at = heard[cKDTree(self.process.places[heard]).query(loud.places)[1]]
        if len(self.means):
            trend = self.process.trend
            loud = loud.at(covering(loud.places, COVER, self.seed))
            places = torch.from_numpy(loud.places)
            values = loud.decibels - trend.mean(places).numpy()
            self.alone = ridge(trend.terms(places).numpy(), values, self.process.kernel.amplitude)

    @torch.no_grad()
    def forward(self, tx: Tensor, rx: Pose) -> Posterior:
        """See `ConditionalField`; (B, 1) linear powers.

        What is explained is the mean law and the Gaussians fitted without the process: with it, a process of
        a long length may hold what they could say as well.

        Raises:
            ValueError: before `condition`.
        """
        process, places = self._conditioned(), self._places(tx, rx)
        parts = [self._answer(process, part) for part in places.split(QUERIES)]
        mean, spread, share, explained = (torch.cat(part) for part in zip(*parts, strict=True))
        power = self._power(mean)
        said = self._power(explained) if self.count else None
        return Posterior(power, entry_variance(spread.float(), power, "rssi"), said, share.float())

    def mean_at(self, tx: Tensor, rx: Pose) -> Tensor:
        """The mean (B, 1) alone, with autograd for places."""
        process, places = self._conditioned(), self._places(tx, rx)
        decibels = process.mean_at(places)
        if self.fringes is not None:
            decibels, _ = self.fringes.blended(decibels, places, self._distance(places.detach()))
        return self._power(decibels)

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`; of rows where something was heard.

        Of very many rows each is predicted without all that was measured at its place.

        Raises:
            ValueError: before `condition`.
        """
        process = self._conditioned()
        posterior = process.posterior
        mean, variance = posterior.left_out()
        loud = (posterior.extra == 0).numpy() if isinstance(posterior, Exact) else self.at
        decibels, spread = mean[loud, 0], process.kernel.amplitude * variance[loud]
        places = process.places[loud]
        if self.fringes is not None:
            decibels, factor = self.fringes.blended_unseen(
                decibels, torch.from_numpy(places), nearest(places), self.known
            )
            spread = spread * factor
        mean = self._power(decibels)
        return LeftOutRows(self.known, mean, entry_variance(spread.float(), mean, "rssi"))

    def state(self) -> dict[str, Any]:
        """See `ConditionalField`."""
        values = {name: value.detach().clone() for name, value in self.named_parameters()}
        return {
            **values,
            **self.trend.state(),
            "still": [] if self.still is None else [*self.still],
            "seed": self.seed,
            "most": self.most.nan_to_num(),  # a checkpoint has finite numbers
            "known": torch.from_numpy(self.known),
            "at": torch.from_numpy(self.at),
            "decibels": torch.from_numpy(self.decibels),
            "alone": torch.from_numpy(self.alone),
            **({} if self.fringes is None else {"fringes": self.fringes.state()}),
            **({} if self.process is None else {"process": self.process.state()}),
        }

    def _answer(self, process: PowerProcess, places: Tensor) -> tuple[Tensor, ...]:
        """Mean [dB], its variance [dB^2], share of the prior's, and what is explained [dB], each (b,)."""
        mean, spread, share = process.answer(places)
        if self.fringes is not None:
            mean, factor = self.fringes.blended(mean, places, self._distance(places))
            return mean, spread * factor, share, self.fringes.solutions(places).mean(1)
        if not self.count:
            return mean, spread, share, mean
        law = process.trend.mean(places)
        return mean, spread, share, law + process.trend.terms(places) @ torch.from_numpy(self.alone)

    def _distance(self, places: Tensor) -> np.ndarray:
        """From the nearest known row (B,) [m]."""
        if self._tree is None:
            self._tree = cKDTree(self._conditioned().places)
        return self._tree.query(places.numpy())[0]

    def _conditioned(self) -> PowerProcess:
        if self.process is None:
            raise ValueError("a field of powers: condition it first")
        return self.process

    def _places(self, tx: Tensor, rx: Pose) -> Tensor:
        """(B, 3) of the moving end, or (B, 6) of both, float64 [m]."""
        return self.site.moving(tx, rx).expand(len(tx), -1).cpu().double()

    def _power(self, decibels: Tensor) -> Tensor:
        return from_real(decibels[:, None].float(), "rssi", (1,))


def ridge(columns: np.ndarray, values: np.ndarray, prior: float) -> np.ndarray:
    """Weights (P,) of columns (n, P) with a prior variance, when what is left of values (n,) is white."""
    weights, left = np.zeros(columns.shape[1]), float((values**2).mean())
    for _ in range(RIDGE_STEPS):
        gram = columns.T @ columns + left / prior * np.eye(columns.shape[1])
        right = torch.from_numpy(columns.T @ values)[:, None]
        weights = Factor.of(torch.from_numpy(gram)).solved(right)[:, 0].numpy()
        left = max(float(((values - columns @ weights) ** 2).mean()), 1e-12)
    return weights


def rows_of(data: Measurements, rows: np.ndarray) -> Rows:
    """Powers of rows (n,) in decibels, levels where nothing was heard."""
    decibels = to_real(training_targets(data, rows), "rssi")[:, 0].astype(np.float64)
    return Rows(data.moving[rows], decibels, silent(data, rows))


def initialise(
    data: Measurements,
    rows: np.ndarray,
    fringes: bool = True,
    seed: int = 0,
    budget: TimeBudget | None = None,
    known: Blockers | None = None,
) -> tuple[PowerField, tuple[str, ...]]:
    """A field of powers and what must be said of it; `condition` is to follow.

    Walls are kept unless they predict groups of places that were left out worse than the plain process does,
    by more than one standard error.

    Args:
        data: powers, of one station where there are several.
        rows: (n,) to learn from, at least one.
        fringes: whether coherent waves are sought where neighbours are closer than half a wavelength.
        seed: of rows, waves and groups that are drawn.
        budget: walls are not tried beyond it.
        known: Gaussians that stand for walls, with strengths in decibels; no waves are sought beside them.

    Raises:
        ValueError: not powers, several stations, or no rows.
    """
    if data.site.kind != "rssi":
        raise ValueError(f"a field of powers needs received powers (rssi), not {data.site.kind}")
    if data.site.stations is not None and len(data.site.stations) > 1:
        raise ValueError(f"a field of powers is of one station, not of {len(data.site.stations)}")
    if not len(rows):
        raise ValueError("a field of powers needs at least one row")
    seen = rows_of(data, rows)
    pace = haste(budget, CHOOSING, len(rows))
    trend, kernel, notes = choose_prior(seen, data.site, "auto", seed, pace)
    bare = PowerField(data.site, trend, kernel, Blockers.none(), None, seed)
    if fringes and known is None and not seen.silent.any() and sampled(seen.places, data.site.wavelength):
        order = np.argsort(rows)
        assert data.site.wavelength is not None
        bare.fringes, said = find_fringes(
            seen.at(order), rows[order], bare.prior(), data.site.wavelength, seed, budget
        )
        return bare, (*notes, said)
    if known is None:
        return bare, notes
    found = shadowed(seen, data.site, seed, budget, known)
    if found is None:
        return bare, (*notes, "no Gaussians: there are no walls, or too few rows were heard")
    gain = gain_of_groups(seen, data.site, seed, budget, known)
    if gain is None and budget is not None and budget.over():
        return bare, (*notes, "no Gaussians: no time to try them on groups of places that are left out")
    said = "too few rows for trying them on groups of places that are left out"
    if gain is not None:
        before, after = math.sqrt(gain.others), math.sqrt(max(gain.others - gain.squares, 0.0))
        said = f"groups of places left out: rmse {before:.3g} dB without Gaussians, {after:.3g} dB with them"
        said += f" (gain {gain.squares:.2g} +- {gain.error:.2g} dB^2)"
        if not gain.exceeds(-SURE):
            return bare, (*notes, f"no Gaussians; {said}")
    trend, kernel, more = found
    assert trend.blockers is not None
    law = Trend(trend.level, trend.law, trend.middle, trend.spread)
    field = PowerField(data.site, law, kernel, trend.blockers, trend.still, seed)
    return field, (f"{field.count} Gaussians in the way of paths; {said}", *more)


def shadowed(
    rows: Rows, site: Site, seed: int, budget: TimeBudget | None, known: Blockers
) -> tuple[ShadowedTrend, Kernel, tuple[str, ...]] | None:
    """A prior with Gaussians of strengths in decibels beside a law, and notes; None: too few rows."""
    loud = rows.at(np.flatnonzero(~rows.silent))
    few = loud.at(draw(loud.silent, TRIED_ON, seed))
    if not len(known) or len(few.places) < max(LAW_NEEDS, 2) or len(np.unique(few.places[:, :3], axis=0)) < 2:
        return None
    plain, kernel, _ = choose_prior(few, site, "distance", seed, haste(budget, HASTY, len(few.places)))
    assert plain.law is not None
    trend = ShadowedTrend.over(plain, known.relative_to(kernel.amplitude), plain.law.place)
    return trend, *choose_about(rows, trend, seed, haste(budget, HASTY, len(rows.places)))


def gain_of_groups(
    rows: Rows, site: Site, seed: int, budget: TimeBudget | None, known: Blockers
) -> Gain | None:
    """What Gaussians gain over the plain process at groups of places left out; None where time is over.

    Both are found without the groups, on a part of many rows.
    """
    group = groups(rows.places)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for part in folds(group, FOLDS, seed):
        if budget and budget.over():
            return None
        rest = np.setdiff1d(np.arange(len(group)), part)
        asked = part[~rows.silent[part]]
        asked = asked[draw(np.zeros(len(asked), bool), MOST_ASKED, seed)]
        learned = rows.at(rest).at(draw(rows.silent[rest], TRIED_ON, seed))
        if len(asked) == 0 or int((~learned.silent).sum()) < LEAST:
            continue
        queries, measured = torch.from_numpy(rows.places[asked]), rows.decibels[asked]
        process, _ = fit_powers(learned, site, "auto", seed, haste(budget, HASTY, len(learned.places)))
        without = process.mean_at(queries).numpy() - measured
        found = shadowed(learned, site, seed, budget, known)
        if found is not None:
            process, _ = conditioned(learned, found[0], found[1], seed)
        error = process.mean_at(queries).numpy() - measured
        parts.append((error**2, without**2, group[asked]))
    if not parts:
        return None
    one, other, told = (np.concatenate(part) for part in zip(*parts, strict=True))
    return compared(one, other, told)


def restored(site: Site, state: dict[str, Any]) -> PowerField:
    """The field whose `state()` this was."""
    still = [float(v) for v in state["still"]]
    names = ("means", "log_scales", "turns", "log_strengths")
    two = len(state["log_lengths"]) == 2
    kernel = Kernel((1.0,) * (2 if two else 1), (0.5, 0.5) if two else (1.0,), 1.0, 1.0)
    most = torch.as_tensor(state["most"]).double()
    field = PowerField(
        site, trend_of(state), kernel, Blockers(*(state[name] for name in names), most=most),
        _place(still), int(state["seed"]), fringes_of(state["fringes"]) if "fringes" in state else None,
    )  # fmt: skip
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            parameter.copy_(state[name])
    field.known, field.decibels = state["known"].numpy(), state["decibels"].numpy()
    field.alone, field.at = state["alone"].numpy(), state["at"].numpy()
    if "process" in state:
        field.process = PowerProcess.read(state["process"]).about(field.prior()[0])
    return field


def _place(values: list[float]) -> Place | None:
    return (values[0], values[1], values[2]) if values else None
