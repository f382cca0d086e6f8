"""Which coherent effects a site calls for: decided from what it measures and a quick probe, and said."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import Explains, FitContext, Method
from gsparc.methods.time_budget import Clock, less_repeatable

Switch = bool | Literal["auto", "splat"]
SPLAT: Literal["splat"] = "splat"

DENSE = 0.25  # neighbours closer than this many wavelengths can be interpolated without a carrier
PROBE_IMAGES = 12
LOOSE = 0.5  # wavelengths between neighbours beyond which their vectors need not tell of one another
CONTEST_ROWS = 400  # neighbouring training spectra that a contest of two methods is held on


@dataclass(frozen=True)
class EffectSettings:
    """Switches: `auto`, true, false, or `splat`: a term of the splatted field itself; off means not computed.

    Attributes:
        phase: carrier phase from source positions (channels of a moving receiver).
        array: array response (spectra with a declared array: the array's vectors where it is static, bearings
            of sources where it moves).
        directions: measured directions of arrival say where sources are and who sees them; never `splat`.
        hybrid: a process for what the sources of `phase` leave over; never `splat`.
    """

    phase: Switch = "auto"
    array: Switch = "auto"
    directions: Switch = "auto"
    hybrid: Switch = "auto"


@dataclass(frozen=True)
class Decision:
    """One effect, settled.

    Attributes:
        effect: its switch's name.
        on: whether it is computed.
        reason: one clause, with the measurement that decided.
        seconds: what deciding cost [s].
        limited_by: the clock whose seconds ended a trial.
    """

    effect: str
    on: bool
    reason: str
    seconds: float = 0.0
    limited_by: Clock | None = None

    def __str__(self) -> str:
        cost = f" ({self.seconds:.1f} s to find out)" if self.seconds >= 0.1 else ""
        return f"effects.{self.effect} -> {'on' if self.on else 'off'}: {self.reason}{cost}"


def decide_phase(switch: Switch, site: Site, splatting: str | None, antennas: int = 1) -> Decision:
    """Whether the channels' phase is to come from source positions, before any probe.

    Args:
        switch: as configured.
        site: what the dataset declares.
        splatting: setting that asks for the splatted field, or None.
        antennas: of the receiver.

    Raises:
        ValueError: asked for where it has no meaning.
    """
    obstacle = None
    if site.kind != "csi":
        obstacle = f"the target is {site.kind}, which carries no phase"
    elif site.static_end == "rx" and antennas > 1:
        obstacle = f"the transmitter moves before {antennas} antennas; sources are found for one of them"
    elif site.static_end == "rx" and switch == SPLAT:
        obstacle = "the transmitter moves; splatted phase is modelled for a moving receiver"
    elif site.carrier_hz is None and site.subcarriers_hz is None:
        obstacle = "the dataset declares no frequency"
    elif switch == "auto" and splatting is not None:
        obstacle = f"{splatting} asks for the splatted field"
    return _settle("phase", switch, obstacle, SPLAT)


def decide_array(switch: Switch, site: Site, splatting: str | None) -> Decision:
    """Whether spectra are to be explained by the array's complex vectors, before any probe.

    Args:
        switch: as configured.
        site: what the dataset declares.
        splatting: setting that asks for the splatted field, or None.

    Raises:
        ValueError: asked for where it has no meaning.
    """
    obstacle = None
    if site.kind != "spectrum":
        obstacle = f"the target is {site.kind}, not a spectrum"
    elif site.static_end != "rx" and switch == SPLAT:
        obstacle = "the receiver moves; splat then A is modelled for a static array"
    elif site.array is None or len(site.array) < 2 or site.wavelength is None:
        obstacle = "the dataset declares no array or no carrier"
    elif switch == "auto" and splatting is not None:
        obstacle = f"{splatting} asks for the splatted field"
    return _settle("array", switch, obstacle, SPLAT)


def decide_directions(switch: Switch, sources: bool, data: Measurements) -> Decision:
    """Whether measured directions of arrival are to be used.

    Args:
        switch: as configured.
        sources: whether the carrier's phase is to come from sources; `auto` follows it.
        data: measurements; only whether they have directions is looked at.

    Raises:
        ValueError: asked for where there is nothing to use.
    """
    obstacle = None
    if data.site.kind != "csi" or data.site.static_end != "tx" or data.site.wavelength is None:
        obstacle = "they are for channels of a moving receiver at a known carrier"
    elif data.directions is None:
        obstacle = "no directions of arrival were measured"
    elif switch == "auto" and not sources:
        obstacle = "no sources with carrier phase are asked for"
    return _settle("directions", switch, obstacle)


def _settle(effect: str, switch: Switch, obstacle: str | None, *splat: Switch) -> Decision:
    choices, asked = ("auto", *splat, True, False), f"model.effects.{effect}={str(switch).lower()}"
    if switch not in choices:
        named = [str(choice).lower() for choice in choices]
        raise ValueError(f"{asked}: choose {', '.join(named[:-1])} or {named[-1]}")
    if switch in (SPLAT, True) and obstacle is not None:
        raise ValueError(f"{asked} is not possible: {obstacle}")
    if obstacle is not None:
        return Decision(effect, False, obstacle)
    if switch == SPLAT:
        return Decision(effect, True, "as configured, a term of the splatted field")
    return Decision(effect, switch is not False, "possible" if switch == "auto" else "as configured")


def spacing_in_wavelengths(data: Measurements, rows: np.ndarray) -> float:
    """Median distance of rows (n,) to the nearest other, in wavelengths; infinite without a carrier."""
    positions = data.moving[rows]
    if len(positions) < 2 or data.site.wavelength is None:
        return float("inf")
    nearest = cKDTree(positions).query(positions, k=2)[0][:, 1]
    return float(np.median(nearest)) / data.site.wavelength


def fifths(rows: np.ndarray, seed: int) -> list[Fold]:
    """Five folds of training rows, each with another fifth held out as its test rows; the draw is seeded."""
    order = np.random.default_rng(seed).permutation(rows)
    parts = [part for part in np.array_split(order, 5) if len(part)]
    return [Fold(np.sort(np.setdiff1d(rows, part)), part[:0], part) for part in parts]


def nmse_of(method: Method, data: Measurements, rows: np.ndarray) -> float:
    """Normalised mean squared error of a fitted method on rows of channels."""
    batch = data.batch(rows)
    miss = (method.predict(batch.tx, batch.rx).mean - batch.target).abs().square().sum()
    return float(miss / batch.target.abs().square().sum())


def probe_phase(
    trial: Method, rival: Method, data: Measurements, fold: Fold, seed: int, clock: Clock = "wall"
) -> Decision:
    """Let a small coherent search and the Gaussian process predict a held-out fifth of the training rows.

    Args:
        trial: an unfitted coherent method with a small budget.
        rival: an unfitted interpolator.
        data, fold: only training rows are looked at.
        seed: of the draw.
        clock: of the trial's seconds.
    """
    started, limited = time.perf_counter(), None
    dense = spacing_in_wavelengths(data, fold.train)
    inner = fifths(fold.train, seed)[0]
    if not (data.target[inner.train].any() and data.target[inner.test].any()):
        silent = "the channels to probe with are silent"
        return Decision("phase", False, silent, time.perf_counter() - started)
    errors = []
    for method in (trial, rival):
        limited = less_repeatable(limited, method.fit(data, inner, FitContext(budget_clock=clock)).limited_by)
        errors.append(nmse_of(method, data, inner.test))
    reason = (
        f"neighbours are {dense:.2f} wavelengths apart"
        f"{' (dense enough to interpolate)' if dense < DENSE else ''}; on a held-out fifth of the training "
        f"data a short search leaves NMSE {errors[0]:.3f}, the Gaussian process {errors[1]:.3f}"
    )
    return Decision("phase", errors[0] < errors[1], reason, time.perf_counter() - started, limited)


def probe_array(candidate: Method, data: Measurements, fold: Fold, seed: int) -> Decision:
    """Can the declared array have measured a few of the training images?"""
    started = time.perf_counter()
    spread = np.linspace(0, len(fold.train) - 1, min(PROBE_IMAGES, len(fold.train))).astype(int)
    assert isinstance(candidate, Explains)
    holds, reason = candidate.explains(data, np.unique(fold.train[spread]), seed)
    return Decision("array", holds, reason, time.perf_counter() - started)


def contest_array(trial: Method, rival: Method, data: Measurements, fold: Fold, seed: int) -> Decision:
    """Let the array and a process of images predict a held-out fifth of training spectra that lie far apart.

    Leaving out single vectors does not tell: their phases were settled together, and among neighbours
    wavelengths apart that alone makes them agree.

    Args:
        trial: an unfitted array field.
        rival: an unfitted interpolator.
        data, fold: only training rows are looked at.
        seed: of the draw.
    """
    started, rows, limited = time.perf_counter(), fold.train, None
    apart = spacing_in_wavelengths(data, rows)
    if apart < LOOSE or len(rows) < 10:
        return Decision("array", True, "neighbours are near enough to tell of one another")
    if len(rows) > CONTEST_ROWS:
        places = data.moving[rows]
        middle = places[np.random.default_rng(seed).integers(len(rows))]
        rows = np.sort(rows[np.argsort(np.linalg.norm(places - middle, axis=1))[:CONTEST_ROWS]])
    inner = fifths(rows, seed)[0]
    batch, errors = data.batch(inner.test), []
    for method in (trial, rival):
        with tempfile.TemporaryDirectory() as aside:  # what a trial writes is no part of the run
            limited = less_repeatable(limited, method.fit(data, inner, FitContext(Path(aside))).limited_by)
        errors.append(float((method.predict(batch.tx, batch.rx).mean - batch.target).square().mean()))
    reason = (
        f"neighbours are {apart:.2f} wavelengths apart; on a held-out fifth of the training spectra the "
        f"array's squared error is {errors[0]:.4f}, the Gaussian process's {errors[1]:.4f}"
    )
    return Decision("array", errors[0] < errors[1], reason, time.perf_counter() - started, limited)
