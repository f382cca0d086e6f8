"""Terms of a user's own (`model.terms`); see docs/terms.md."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from gsparc.base.files import Files
from gsparc.data.schema import OF_STATION, Measurements, Site
from gsparc.models.powers.prior_map import NetworkMaps, PriorMap
from gsparc.processes.places import has_both_ends
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerRows
from gsparc.processes.stored import MAIN
from gsparc.processes.term import Columns
from gsparc.processes.trend import Trend

log = logging.getLogger(__name__)

CERTAIN, TINY = 1e-9, 1e-12  # in place of a deviation [dB] and of a precision of 0
POOLED_FROM = 6  # stations, from which on a weight of all as the prior of each predicts better
LARGEST = 1e4  # of a column [deviations]: squares of larger ones hide the noise in a covariance


def to_terms(terms: Any) -> tuple[Columns, ...]:
    """Return terms (`model.terms`) as a tuple, one alone as of one;
    `ValueError` for what is none.
    """
    result = tuple(terms) if isinstance(terms, Sequence) else (terms,)
    for term in result:
        if not isinstance(term, Columns):
            raise ValueError(f"model.terms: {term!r} is not a gsparc.processes.term.Columns")
        if type(term).__module__ == MAIN:
            advice = "a saved model opens only where it is defined; move it to a file"
            log.warning(
                "model.terms: %s is of a notebook or script: %s", type(term).__name__, advice
            )
    return result


@dataclass(frozen=True)
class OwnTerms:
    """What a user says of one station's powers before any row;
    each attribute is a setting of `model`.

    Attributes:
        terms: further columns of the mean.
        prior: files of levels, see `read_prior_levels`; None: nothing was predicted.
    """

    terms: tuple[Columns, ...] = ()
    prior: Files | None = None

    @property
    def said(self) -> list[str]:
        """What is given, as a message begins: the setting and its verb."""
        verbs = {"terms": "are", "prior": "is"}
        return [f"model.{name} {verb}" for name, verb in verbs.items() if getattr(self, name)]

    def columns(self, data: Measurements) -> tuple[Columns, ...]:
        """Return all as columns for measurements of a station or a network."""
        if self.prior is None:
            return self.terms
        if data.site.paired:
            log.warning(
                "model.prior has no effect here: a map is about one end that moves, and both do"
            )
            return self.terms
        if data.site.several:
            return (*self.terms, NetworkMaps.from_file(self.prior, data))
        (station,), still = data.site.every_station.shown, data.site.every_station.position[0]
        station = (
            data.site.name.rpartition(OF_STATION)[2] if OF_STATION in data.site.name else station
        )
        still = still + data.site.origin
        return (*self.terms, PriorMap.from_file(self.prior, data, station, still))


@dataclass(frozen=True)
class UserTerm(Columns):
    """A term that is asked of both ends in the coordinates of the measurements.

    Attributes:
        term: of a user.
        origin: (3,) of local coordinates [m].
        still: (3,) the end that stands, local [m]; None where unknown, or where both move.
        middle: (Q,) mean columns of the rows, less which they are nearly independent of the level.
        unit: deviation of the process [dB], which columns are relative to.
        spread_db: deviation of a weight that the term says nothing of [dB of a column's unit];
            0: that of the process.
    """

    term: Columns
    origin: Tensor
    still: Tensor | None
    middle: Tensor | float = 0.0
    unit: float = 1.0
    spread_db: float = 0.0

    @classmethod
    def from_site(cls, term: Columns, site: Site) -> Self:
        """Return a term of a site of one station, or of ends that both move."""
        origin, still = site.origin.astype(np.float64), site.every_station.position[0]
        known = np.isfinite(still).all()  # NaN could be written to a checkpoint, and never read
        return cls(term, torch.from_numpy(origin), torch.from_numpy(still) if known else None)

    @property
    def weight_prior(self) -> tuple[float, float]:
        """Mean [dB] and deviation [units] of each weight, of a column's unit."""
        mean, deviation = self.term.prior_db or (0.0, self.spread_db or self.unit)
        return mean, deviation / self.unit

    def columns(self, places: Tensor) -> Tensor:
        """See `Columns`; of places of the moving end (n, 3), or of both (n, 6),
        in local coordinates.
        """
        return self.weight_prior[1] * (self._user_columns(places) - self.middle)

    def mean(self, places: Tensor) -> Tensor:
        """See `Columns`."""
        mean, _ = self.weight_prior
        return mean * self._user_columns(places).sum(1) if mean else super().mean(places)

    def _user_columns(self, places: Tensor) -> Tensor:
        still = torch.full((3,), torch.nan) if self.still is None else self.still
        both = places if has_both_ends(places) else torch.cat([places, still.expand_as(places)], 1)
        result = self.term.columns(both + torch.cat([self.origin, self.origin]))
        if not isinstance(result, Tensor):
            gave = f"{type(self.term).__name__}.columns gave {type(result).__name__}"
            raise ValueError(f"{gave}; a torch tensor ({len(places)}, Q) is needed")
        return result

    def centre(self, places: Tensor) -> Self:
        """Return it centred at places (n, D) [m].

        Raises:
            ValueError: the prior is none, or columns cannot be used.
        """
        name, prior = type(self.term).__name__, self.term.prior_db
        numbers = [0.0, 0.0] if prior is None else prior
        if np.shape(numbers) != (2,) or not np.isfinite(numbers).all() or numbers[1] < 0:
            raise ValueError(
                f"{name}.prior_db={prior}: say [mean, deviation] of a weight in dB, such as [0, 3]"
            )
        result = self._user_columns(places)
        gave = f"{name}.columns gave {(*result.shape,)}"
        if result.ndim != 2 or len(result) != len(places):
            raise ValueError(f"{gave}; ({len(places)}, Q) finite numbers are needed")
        if wrong := int((~result.isfinite()).any(1).sum()):
            unknown = not has_both_ends(places) and self.still is None
            why = ", but the place of the end that stands is not given" if unknown else ""
            raise ValueError(
                f"{gave}, NaN or infinite in {wrong} rows; finite numbers are needed{why}"
            )
        if (most := float(result.abs().max())) * (1.0 if prior is None else prior[1]) > LARGEST:
            raise ValueError(
                f"{gave} of up to {most:.2g}; divide them until most are between 0.1 and 10"
            )
        return replace(self, middle=result.mean(0))


def subtract_means(rows: PowerRows, terms: Sequence[UserTerm]) -> PowerRows:
    """Return rows less what terms have as their mean."""
    places = torch.from_numpy(rows.places)
    return replace(rows, decibels=rows.decibels - sum(term.mean(places).numpy() for term in terms))


def add_terms_to_trend(rows: PowerRows, trend: Trend, terms: tuple[UserTerm, ...]) -> Trend:
    """Return a trend of rows less the terms' means, with the terms;
    what these say nothing of spreads as rows do about the trend.
    """
    heard = rows.heard_rows
    residual = heard.decibels - trend.mean(torch.from_numpy(heard.places)).numpy()
    spread = float(residual.std()) or 1.0
    return replace(trend, more=(*trend.more, *(replace(term, spread_db=spread) for term in terms)))


class LearnedWeights(str):
    """A sentence on the weights of a term.

    Attributes:
        name: of the term.
        numbers: (4, Q) their mean and deviation, and those before any row [dB of a column's unit].
    """

    name: str
    numbers: np.ndarray

    @classmethod
    def from_numbers(cls, name: str, numbers: np.ndarray, rest: str = "") -> Self:
        """Put them into words."""
        text = ", ".join(f"{w:.3g} +- {d:.2g}" for w, d in numbers[:2].T)
        result = cls(f"{name}: {text}{rest}")
        result.name, result.numbers = name, numbers
        return result


def describe_weights(posterior: Exact, terms: tuple[UserTerm, ...]) -> list[LearnedWeights]:
    """Return a sentence on each term: its weights [dB of a column's unit] and their deviations."""
    at = posterior.rows
    columns = posterior.prior.columns(at)
    weights, scale = (columns.T @ posterior.weights)[:, 0], posterior.prior.kernel.amplitude
    # Of weights of unit variance, times the amplitude: 1 - C^T K^-1 C.
    std = (scale * (1 - posterior.factor.whiten(columns).square().sum(0)).clamp_min(0)).sqrt()
    numbers = torch.stack(
        [weights, std, torch.zeros_like(std), torch.full_like(std, scale**0.5)]
    ).numpy()
    sizes = [term.columns(at[:1]).shape[1] for term in terms]
    parts = np.split(numbers[:, -sum(sizes) :], np.cumsum(sizes)[:-1], 1)
    classes = [type(term.term).__name__ for term in terms]
    # Several of one class are told apart by their order.
    order = [classes[: k + 1].count(name) for k, name in enumerate(classes)]
    counted = zip(classes, order, strict=True)
    names = [f"{name} {n}" if classes.count(name) > 1 else name for name, n in counted]
    return [
        LearnedWeights.from_numbers(
            name, term.weight_prior[1] * part + [[term.weight_prior[0]], [0]] * 2
        )
        for name, term, part in zip(names, terms, parts, strict=True)
    ]


def pool_station_weights(notes: Sequence[str]) -> dict[str, str]:
    """Return, for what stations say of each term, one sentence: all of them together,
    and how they differ.

    Rows of stations are independent given the weight (random effects: R. DerSimonian, N. Laird,
    Controlled Clinical Trials 7 (1986)).
    """
    weights, result = [note for note in notes if isinstance(note, LearnedWeights)], dict[str, str]()
    for key in {(note.name, note.numbers.shape): None for note in weights}:
        same = [note for note in weights if (note.name, note.numbers.shape) == key]
        means, deviation, before, wide = np.stack([note.numbers for note in same], 1)  # (S, Q) each
        deviation, wide = np.maximum(deviation, CERTAIN), np.maximum(wide, CERTAIN)
        # What rows say alone: the prior is taken out of each, and counts once.
        precision = np.maximum(deviation**-2.0 - wide**-2.0, TINY)
        estimates = (means / deviation**2 - before / wide**2) / precision
        prior_precision, total = wide[0] ** -2.0, precision.sum(0)
        centre = (precision * estimates).sum(0) / total
        excess = (precision * (estimates - centre) ** 2).sum(0) - (len(same) - 1)
        between = np.sqrt(
            np.maximum(excess / np.maximum(total - (precision**2).sum(0) / total, TINY), 0.0)
        )
        precision = 1 / (1 / precision + between**2)
        both = prior_precision + precision.sum(0)
        mean, error = (
            (prior_precision * before[0] + (precision * estimates).sum(0)) / both,
            both**-0.5,
        )
        rest = (
            f" (of {len(same)} stations, which differ by {', '.join(f'{b:.2g}' for b in between)}"
        )
        if len(same) >= POOLED_FROM and len(mean) == 1:
            rest += (
                f"; prior_db=[{mean[0]:.3g}, {np.hypot(error, between)[0]:.2g}] tells each "
                "of the others"
            )
        moments = np.stack([mean, error, before[0], wide[0]])
        result |= dict.fromkeys(
            same, LearnedWeights.from_numbers(key[0], moments, f"{rest})" * (len(same) > 1))
        )
    return result
