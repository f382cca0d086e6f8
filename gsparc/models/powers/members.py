"""Processes of powers that one station's rows are predicted by, and their shares.

A member has a mean, a distance law or none, and a shape, rough or smoother. Its numbers are
the likeliest with what stations elsewhere teach (`known_numbers.py`); level and exponent are
integrated out. Shares have the least squared error at rows left out, shrunk towards what is
believed before any row: with few rows a mean of members is safer than the best of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from gsparc.data.schema import ENDS, Site
from gsparc.models.baselines.distance_law import UNSEEN, locate_still_end, say_estimated
from gsparc.models.baselines.likeliest import likeliest_candidate
from gsparc.models.powers.known_numbers import known_numbers
from gsparc.models.powers.own_terms import UserTerm, add_terms_to_trend, subtract_means
from gsparc.models.powers.prior_map import PriorMap
from gsparc.models.stack import shrunk_weights
from gsparc.processes.few_rows import sample_place_rows
from gsparc.processes.fit_kernel import LOOKS, NumberPrior, fit_kernel_by_evidence
from gsparc.processes.kernel import ExponentialShadowing, Kernel, Shadowing
from gsparc.processes.nearest import Nearest, choose_kernel_by_nearest, condition_on_nearest
from gsparc.processes.places import has_both_ends
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerProcess, PowerRows, condition_on_powers, rows_in_doubt
from gsparc.processes.prior import Prior
from gsparc.processes.sectors import Beam, sector_table
from gsparc.processes.term import Columns
from gsparc.processes.trend import TINY_M, Law, Trend

LEVEL_DB = 20.0  # deviation of a level before any row
# Before any row: of a law about a known place, about one that is sought, of no law; of shapes
LAW, SOUGHT, NONE = 3.0, 1.0, 1.0
SHAPES = (ExponentialShadowing, 3.0), (Shadowing, 1.0)
FREE, FREE_FROM = 1.0, 100  # belief in free numbers, and rows that tell them
PLACE_NEEDS = 8  # rows that were heard, for a place that is sought
LEARNED_ON = 500  # rows: numbers, and shares
NEAREST_FROM = 1_000  # rows, from which on shape and numbers follow from the nearest ones
SPARSEST = 60  # places of a set that shows long lengths
JUDGED_ON = 1_000  # places, that shares are learned on where the nearest rows tell of each
WALKED = 15  # looks at silent rows, from numbers that rows that were heard have
ASKED = 200  # places, whose error is foreseen
MAP_PAYS = 0.05  # of the squared errors at rows left out that a map must take off


class LevelMean(NamedTuple):
    """A trend, its weight before any row, and what must be said of it."""

    trend: Trend
    belief: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PowerMember:
    """A process before any row.

    Attributes:
        trend: of which deviations are in decibels.
        belief: its weight before any row.
        kernel: see `fit_kernel_by_evidence`; before rows were looked at, the usual one.
        notes: what must be said of it.
    """

    trend: Trend
    belief: float
    kernel: Kernel
    notes: tuple[str, ...] = ()

    @property
    def prior(self) -> Prior:
        """Both; the trend is relative to the kernel's deviation."""
        return Prior(self.kernel, self.trend.in_unit(math.sqrt(self.kernel.amplitude)))

    def describe(self, exponent: float) -> str:
        """Return one line of the settings, with the exponent that rows say of its law."""
        law = f"a distance law of exponent {exponent:.3g}"
        mean = "a constant" if self.trend.law is None else law
        share = " and a share of the map" if self.has_map else ""
        return f"{self.kernel.description}, mean: {mean}{share}"

    @property
    def has_map(self) -> bool:
        """Whether the mean has a share of a map from before."""
        own = (term.term for term in self.trend.more if isinstance(term, UserTerm))
        return any(isinstance(term, PriorMap) for term in own)


def learn_members(
    rows: PowerRows,
    site: Site,
    seed: int,
    most: int = LEARNED_ON,
    terms: tuple[UserTerm, ...] = (),
    walls: tuple[Columns, ...] = (),
) -> list[PowerMember]:
    """Return members with the numbers that rows say, the most believed first.

    Args:
        rows: at least one.
        site: where the still end is.
        seed: of rows that are drawn where there are too many.
        most: rows that numbers are learned on.
        terms: of a user; maps from before among them stand in some members alone.
        walls: columns of losses, in the mean of all.
    """
    sure = tuple(term for term in terms if not isinstance(term.term, PriorMap))
    extent = extent_of(rows)
    few, known = rows.heard_rows.draw_subset(most, seed), known_numbers().numbers
    shapes = [(known.start(extent, term), weight) for term, weight in SHAPES]
    if has_both_ends(rows.places):
        path, noise = shapes[0][0].length, shapes[0][0].noise
        ends = replace(Kernel.of_ends(path, path, noise), amplitude=shapes[0][0].amplitude)
        shapes = [shapes[0], (ends, SHAPES[0][1])]
    members = []
    for some in (terms, sure) if len(sure) < len(terms) else (terms,):
        rest = subtract_means(rows, some)
        for mean, belief, notes in means(rest, site, walls):
            trend = add_terms_to_trend(rest, mean, some)
            members += [
                PowerMember(trend, belief * weight, kernel, notes) for kernel, weight in shapes
            ]
    members = [fit_member_kernel(few, member, known, extent, LOOKS) for member in members]
    if len(rows.places) >= FREE_FROM and not (rows.silent.any() or terms or walls):
        members.append(_likeliest(few, site, seed))
    if rows.silent.any() and not rows.silent.all():
        part = rows.draw_subset(most, seed)
        doubtful = rows_in_doubt(part, members[0].prior)
        members = [fit_member_kernel(doubtful, member, known, extent, WALKED) for member in members]
    return members


def _likeliest(rows: PowerRows, site: Site, seed: int) -> PowerMember:
    """The process that `model=gp` has: its numbers are free, and it is printed beside the rest."""
    best = likeliest_candidate(rows, site, seed=seed)
    deviation = math.sqrt(best.kernel.amplitude)
    # Its level and slope are unsure by the process's own deviation.
    trend = replace(best.trend, level_db=deviation, spread=best.trend.spread / deviation)
    return PowerMember(trend, FREE, best.kernel, best.notes)


def extent_of(rows: PowerRows) -> float:
    """Return the diagonal of the rows' box [m]; of one place 1."""
    return float(np.linalg.norm(np.ptp(rows.places, axis=0))) or 1.0


def exponent_of(process: PowerProcess) -> float:
    """Return the exponent that rows say; 0 without a law."""
    trend, posterior = process.trend, process.posterior
    if trend.law is None:
        return 0.0
    if isinstance(posterior, Exact):
        slope = posterior._trend_columns[:, 1] @ posterior.weights[:, 0]
    else:
        assert isinstance(posterior, Nearest)
        slope = posterior.terms[1, 0]
    return trend.law.exponent - float(slope) / (10 * trend.spread * trend.unit)


def means(rows: PowerRows, site: Site, walls: tuple[Columns, ...]) -> list[LevelMean]:
    """Return what levels may be about, the law first.

    Args:
        rows: at least one.
        site: where the still end is; a place that nobody gave is sought from `PLACE_NEEDS` rows on.
        walls: further columns.
    """
    level = float(rows.heard_rows.decibels.mean())
    none = LevelMean(Trend(level, more=walls, level_db=LEVEL_DB), NONE)
    still, notes, belief = site.static_position, tuple[str, ...](), LAW
    if has_both_ends(rows.places):
        still = None
    elif still is None or not np.isfinite(still).all():
        if (~rows.silent).sum() < PLACE_NEEDS:
            return [none]
        still, belief = locate_still_end(rows), SOUGHT
        notes = (f"the {ENDS[site.still_end]}'s place {say_estimated(still + site.origin)}",)
    at = None if still is None else (float(still[0]), float(still[1]), float(still[2]))
    (exponent, unsure), places = known_numbers().exponent, torch.from_numpy(rows.places)
    law = Law(0.0, exponent, TINY_M, 1.0, at)
    nearest = float(law.distance(places).min())
    # A place that was sought is itself as unsure as its nearest row is far.
    law = replace(law, floor=max(nearest if notes else nearest / UNSEEN, TINY_M))
    decades = law.decades(places)
    law = replace(law, level=level + 10 * exponent * float(decades.mean()))
    slope = 1 / (10 * unsure)
    beams = site.every_station.beams
    if at is not None and not notes and np.isfinite(beams[0, 0]):
        beam = Beam(sector_table(beams[:1]), torch.tensor(at, dtype=torch.float64))
        walls = (*walls, replace(beam, middle=float(beam.loss(places).mean())))
    trend = Trend(0.0, law, float(decades.mean()), slope, walls, LEVEL_DB)
    return [LevelMean(trend, belief, notes), none]


def fit_member_kernel(
    rows: PowerRows, member: PowerMember, known: NumberPrior, extent: float, looks: int
) -> PowerMember:
    """Return the member with its likeliest numbers, beginning at its own.

    Args:
        rows: at least one.
        member: to begin with.
        known: of numbers before any row.
        extent: of all rows [m].
        looks: most evaluations.
    """
    view = rows.view(member.trend, member.kernel)
    side = None if rows.silent.all() else view.side
    _, kernel = fit_kernel_by_evidence(
        member.kernel, [view._replace(side=side)], looks, known, extent
    )
    return replace(member, kernel=kernel)


def foresee_errors(rows: PowerRows, site: Site, further: int, seed: int = 0) -> tuple[float, float]:
    """Return the error at places between rows that these leave, and the one that further rows there
    would leave [dB].

    Args:
        rows: at least one.
        site: where the still end is.
        further: rows, at places drawn by chance.
        seed: of these.
    """
    prior = weigh_members(rows, learn_members(rows, site, seed), seed)[0][0][1]
    process, _ = condition_on_powers(rows, prior, seed)
    rng, ends = np.random.default_rng(seed), (rows.places.min(0), rows.places.max(0))
    asked, more = (rng.uniform(*ends, (count, len(ends[0]))) for count in (ASKED, further))
    levels = process.mean_at(torch.from_numpy(more)).numpy()
    parts = (rows.places, more), (rows.decibels, levels), (rows.side, np.zeros(further, np.int8))
    wider, _ = condition_on_powers(PowerRows(*map(np.concatenate, parts)), prior, seed)
    places = torch.from_numpy(asked)
    now, later = (float(part.answer(places).variance.mean()) for part in (process, wider))
    return math.sqrt(now), math.sqrt(later)


def weigh_members(
    rows: PowerRows, members: list[PowerMember], seed: int, most: int = LEARNED_ON
) -> tuple[tuple[tuple[float, Prior], ...], tuple[str, ...]]:
    """Return priors with their shares, the largest first, and what must be said of them.

    Args:
        rows: at least one.
        members: of these rows.
        seed: of rows that are drawn where there are too many.
        most: rows that shares are learned on.
    """
    part, belief = rows.draw_subset(most, seed), np.array([m.belief for m in members])
    processes = [condition_on_powers(part, member.prior, seed)[0] for member in members]
    errors = np.stack([_left_out_errors(part, process) for process in processes], 1)
    exponents = {
        id(m.trend): exponent_of(process) for m, process in zip(members, processes, strict=True)
    }
    shares = shrunk_weights(errors, belief)
    bare = np.array([not member.has_map for member in members])
    if bare.any() and not bare.all():
        alone = shrunk_weights(errors, belief * bare)
        # Both were chosen on these rows: what a map gains by chance is no gain elsewhere.
        if ((errors @ shares) ** 2).mean() > (1 - MAP_PAYS) * ((errors @ alone) ** 2).mean():
            shares = alone
    weighed = [(float(shares[k]), members[k]) for k in np.flatnonzero(shares)]
    if len(rows.places) > NEAREST_FROM and not rows.silent.any():
        weighed = _by_nearest(rows, weighed, seed)
    weighed = sorted(weighed, key=lambda pair: -pair[0])
    texts = [member.describe(exponents[id(member.trend)]) for _, member in weighed]
    notes = dict.fromkeys(note for _, member in weighed for note in member.notes)
    if len(weighed) > 1:
        pairs = zip(weighed, texts, strict=True)
        texts = [f"{share:.0%} of {text}" for (share, _), text in pairs]
    return tuple((share, member.prior) for share, member in weighed), (*texts, *notes)


def _by_nearest(
    rows: PowerRows, weighed: list[tuple[float, PowerMember]], seed: int
) -> list[tuple[float, PowerMember]]:
    """A member for each mean, with a shape and numbers that rows say of others near them,
    and shares of the least error at places predicted from these.
    """
    result, values = [], rows.means_at_places()
    some = torch.from_numpy(sample_place_rows(values.places, JUDGED_ON, seed))
    errors = []
    for trend in {id(member.trend): member.trend for _, member in weighed}.values():
        alike = [(share, member) for share, member in weighed if member.trend is trend]
        member = max(alike, key=lambda pair: pair[0])[1]
        if member.kernel.is_isotropic:
            kernel, how = choose_kernel_by_nearest(member.prior, values, seed, sparsest=SPARSEST)
            member = replace(member, kernel=kernel, notes=(*member.notes, f"then {how}"))
        result.append((sum(share for share, _ in alike), member))
        answers = condition_on_nearest(member.prior, values, seed).left_out(some).mean
        errors.append((answers - values.values[some])[:, 0].numpy())
    # Among many rows it hardly matters what levels are about: equals, before these errors.
    shares = shrunk_weights(np.stack(errors, 1), np.ones(len(result)))
    return [(float(shares[k]), result[k][1]) for k in np.flatnonzero(shares)]


def _left_out_errors(rows: PowerRows, process: PowerProcess) -> np.ndarray:
    """Errors (n,) [dB] of rows that were heard, each predicted from all others."""
    posterior = process.posterior
    assert isinstance(posterior, Exact)
    if rows.silent.all():
        return np.zeros(0)
    return posterior.left_out_residuals().residual[posterior.extra == 0, 0].numpy()
