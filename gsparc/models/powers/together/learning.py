"""Settings of stations' own processes by rows left out, and of what all share by stations left out.

Where a station was heard its own process takes most of what shared terms could say, so the
likelihood of its rows hardly tells how strong they are.
Each station by turns is predicted from the others instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from gsparc.models.baselines.distance_law import fit_law
from gsparc.models.baselines.likeliest import EVIDENCE_LOOKS
from gsparc.models.powers.together.terms import SharedTerms, StationRows
from gsparc.processes.density import left_out_density
from gsparc.processes.fit_kernel import fit_kernel_by_evidence, fit_kernel_by_left_out
from gsparc.processes.kernel import Kernel, distances, median_distance
from gsparc.processes.places import extra_columns, first_end
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import LEAST_SILENT, MOST_ROWS, condition_on_powers
from gsparc.processes.prior import Prior
from gsparc.processes.shared import (
    Block,
    SharedTermsPosterior,
    left_out_processes,
    process_deviation,
)
from gsparc.processes.trend import Trend
from gsparc.processes.uncertainty import mean_and_error

# Lengths in median distances between places
START = Kernel.from_lengths((0.1, 1.0), (0.5, 0.5), 0.3)
LEAST_DB2 = 1e-6  # of a station's process: levels that are equal to the last digit leave none
ALIKE = 10.0  # rows that the amplitude of all stations counts as, for one of them
SLOPE_DB = 2.0  # a decade: deviation of a station's slope
LEARNED_EACH = 500  # rows of each station, for the law and for settings that all have alike
WEIGHED_EACH = 160  # the same where some were silent: each look factors several covariances
# Rows that a station needs for settings of its own, and has them from
ENDS_FROM, ENDS_ON = 400, 700
LEAST_STATIONS = 3  # to leave some out
TRIED_ON = 3_600  # rows of all stations for the strength of shared terms
TRIED_EACH = 300  # of each, and places that the shared process is known at
LENGTHS = (0.7, 2.0)  # of the shared process, of a station's shorter one
PLACE = (0.03, 0.1, 0.2)  # variances of g, of a station's own
ERRORS = 1.0  # standard errors that the gain of shared terms over the law alone must exceed
# Amplitudes of a pseudo-value's variance, beyond which it is left out: .5 % of rmse at most
TOLD = 20.0
WIDEST = 4.0  # factor that variances are corrected by at most


@dataclass(frozen=True)
class StationPriors:
    """Priors of stations' own processes.

    Attributes:
        never: of a station that was never heard.
        heard: by station.
    """

    never: Prior
    heard: Mapping[int, Prior]

    def prior(self, number: int) -> Prior:
        """Return that of a station."""
        return self.heard.get(number, self.never)

    def condition(self, rows: StationRows, terms: SharedTerms, seed: int) -> SharedTermsPosterior:
        """Return what rows say; pseudo-values of silent ones follow from their own station's."""
        result = {}
        for number in rows.stations:
            prior, part = self.prior(number), rows.select_station(number)
            places, extra = torch.from_numpy(part.places), None
            values = torch.from_numpy(part.decibels)[:, None]
            if part.silent.any():
                shared = replace(terms, unit=process_deviation(prior))
                wide = replace(prior.known_trend, more=(*prior.known_trend.more, shared))
                # Each sector of a site has a level of its own, which its silent rows bound.
                least = LEAST_SILENT * len(np.unique(extra_columns(part.places), axis=0))
                process = condition_on_powers(part, Prior(prior.kernel, wide), seed, least)[
                    0
                ].posterior
                assert isinstance(process, Exact)
                mask = process.extra <= TOLD
                places, values, extra = (
                    process.rows[mask],
                    process.given_values()[mask],
                    process.extra[mask],
                )
            result[number] = Exact.from_values(prior, places, values, extra)
        return SharedTermsPosterior(result, self.never, terms.columns)

    @property
    def variance(self) -> float:
        """Of a never heard station's process and noise [dB^2]."""
        return self.never.kernel.amplitude * (1 + self.never.kernel.noise)


def learn_station_priors(rows: StationRows, seed: int) -> tuple[StationPriors, list[str]]:
    """Return the law and settings of own processes, alike but for amplitudes, and what must be said
    of them.
    """
    trend, notes = _fit_site_law(rows, seed)
    heard, some_silent = rows.heard_rows, 0 < rows.silent.sum() < len(rows.silent)
    whole = rows.select_complete_places() if some_silent else heard
    kernel, priors = _fit_common_kernel(heard, trend, seed)
    if some_silent:
        each = whole.share_of(MOST_ROWS, WEIGHED_EACH)
        parts = [
            whole.select_station(n).draw_stretches(each, seed).view(trend) for n in whole.stations
        ]
        # What lists hold spreads less than what they were drawn from.
        narrow, (_, kernel) = kernel, fit_kernel_by_evidence(kernel, parts, EVIDENCE_LOOKS)
        wider = kernel.amplitude / narrow.amplitude
        for number, prior in priors.items():
            kernel_here = replace(kernel, amplitude=wider * prior.kernel.amplitude)
            priors[number] = Prior(kernel_here, trend)
    return StationPriors(Prior(kernel, trend), priors), notes


def learn_own_settings(
    rows: StationRows, alike: StationPriors, seed: int
) -> tuple[StationPriors, list[str]]:
    """Return the same with settings of their own for stations of many rows, and what must be said
    of them.
    """
    heard, some_silent = rows.heard_rows, 0 < rows.silent.sum() < len(rows.silent)
    whole = rows.select_complete_places() if some_silent else heard
    numbers = [number for number in whole.stations if (heard.station == number).sum() >= ENDS_FROM]
    priors, kernel, trend = dict(alike.heard), alike.never.kernel, alike.never.known_trend
    for number in numbers:
        if some_silent:
            some = whole.select_station(number).draw_stretches(ENDS_FROM, seed).view(trend)
            _, kernel_here = fit_kernel_by_evidence(priors[number].kernel, [some], EVIDENCE_LOOKS)
        else:
            some = heard.select_station(number).thin_rows(ENDS_ON, seed).view(trend)
            _, kernel_here = fit_kernel_by_left_out([kernel], [some])
        priors[number] = Prior(_with_amplitude(kernel_here, kernel_here.amplitude), trend)
    notes = [f"settings of their own for {len(numbers)} stations"] if numbers else []
    return replace(alike, heard=priors), notes


def _fit_site_law(rows: StationRows, seed: int) -> tuple[Trend, list[str]]:
    """The law of all stations, of their median level, and what must be said of it."""
    few = rows.thin_rows(LEARNED_EACH, seed)
    law = fit_law(few, None)
    residual = few.decibels - law.mean(torch.from_numpy(few.places)).numpy()
    residuals = [residual[few.station == number] for number in few.stations]
    levels, typical = np.array([[part.mean(), part.std()] for part in residuals]).T
    # That of one station may be far off
    law = replace(law, level=law.level + float(np.median(levels)))
    trend = Trend.from_law(law, torch.from_numpy(few.places))
    by = f"distance exponent {law.exponent:.3g}, gains +- {levels.std():.2g} dB"
    spread = max(float(np.median(typical)), 0.1) / SLOPE_DB
    return replace(trend, spread=spread), [f"{len(levels)} stations in one model, {by}"]


def _fit_common_kernel(
    heard: StationRows, trend: Trend, seed: int
) -> tuple[Kernel, dict[int, Prior]]:
    """Lengths and noise that all stations have alike, and priors with the amplitude of each."""
    few = heard.thin_rows(heard.share_of(MOST_ROWS, LEARNED_EACH), seed)
    views = {number: few.select_station(number).view(trend) for number in few.stations}
    at = torch.from_numpy(np.unique(first_end(few.places), axis=0))
    far = distances(at, at)
    lengths = [length * median_distance(far) for length in START.lengths]
    start = Kernel.from_lengths(lengths, START.shares, START.noise)
    _, kernel = fit_kernel_by_left_out([start], [*views.values()], start.bounds(far), alike=ALIKE)
    parts = [(view.gram(kernel), view.values) for view in views.values()]
    kernels = (
        _with_amplitude(kernel, each) for each in left_out_density(parts, alike=ALIKE)[1].tolist()
    )
    priors = {number: Prior(own, trend) for number, own in zip(views, kernels, strict=True)}
    return _with_amplitude(kernel, kernel.amplitude), priors


def _with_amplitude(kernel: Kernel, amplitude: float) -> Kernel:
    """A kernel of an amplitude, of levels that are equal of what is left."""
    return replace(kernel, amplitude=max(amplitude, LEAST_DB2))


class LeftOutStations(NamedTuple):
    """Rows (n,) of stations left out, of the measurements, and their errors (n,) [dB]."""

    rows: np.ndarray
    errors: np.ndarray


def learn_shared_terms(
    rows: StationRows, priors: StationPriors, seed: int
) -> tuple[SharedTerms, float, str, LeftOutStations | None]:
    """Return shared terms for stations that were never heard,
    of least squared error at left-out stations.

    Args:
        rows: of all stations.
        priors: of the stations' own processes.
        seed: of rows and places drawn.

    Returns:
        The terms, possibly of the law alone; the factor of variances that left-out stations ask
        for; and what must be said of what g gains at these, each after one constant.
    """
    heard = rows.heard_rows
    few = heard.thin_rows(heard.share_of(TRIED_ON, TRIED_EACH), seed)
    short = min(priors.never.kernel.lengths)
    bare = SharedTerms.from_rows(
        few, priors.never.known_trend, LENGTHS[0] * short, TRIED_EACH, seed
    )
    if len(few.stations) < LEAST_STATIONS:
        return bare, 1.0, "no shared terms: too few stations to leave some out", None
    processes = priors.condition(few, bare, seed).processes
    best = plain = bare, *_left_out_errors(processes, bare)
    for length in LENGTHS:
        for share in PLACE:
            terms = replace(
                bare, length=length * short, place_db=math.sqrt(share * priors.variance)
            )
            result = _left_out_errors(processes, terms)
            if (result[0] ** 2).mean() < (best[1] ** 2).mean():
                best = terms, *result
    (_, errors, *_), (_, others, _, station, _) = best, plain
    gain, unsure = mean_and_error(others**2 - errors**2, station)
    terms, _, ratio, _, whole = best if gain > ERRORS * unsure else plain
    before, after = (math.sqrt(float((residuals**2).mean())) for residuals in (others, errors))
    remark = (
        f"stations left out, after one constant each: rmse {before:.3g} dB without shared terms, "
        f"{after:.3g} dB with them (gain {gain:.2g} +- {unsure:.2g} dB^2)"
    )
    index = np.concatenate([few.select_station(number).index for number in processes])
    factor = min(max(ratio, 1 / WIDEST), WIDEST)
    return terms, factor, remark, LeftOutStations(index, whole)


def _left_out_errors(
    processes: Mapping[int, Exact], terms: SharedTerms
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Errors (n,) [dB] of what was heard of stations left out, after a constant of each,
    and their stations; and those without that constant.

    Between them the mean square of errors without that constant over their predicted variances.
    """
    whole, ratios = [], []
    blocks = [
        Block.from_process(process, terms.columns(process.rows)) for process in processes.values()
    ]
    for error, variance in left_out_processes(blocks):
        ratios.append(float((error.square() / variance).mean()))
        whole.append(error.numpy())
    errors = np.concatenate([error - error.mean() for error in whole])
    station = np.repeat(np.arange(len(whole)), [len(part) for part in whole])
    return errors, float(np.mean(ratios)), station, np.concatenate(whole)
