"""Contribution of each propagation effect at each receiver,
from the interactions of one full simulation.

Nothing is traced again: without an effect the solver draws other rays, and the difference would
include the solver's noise.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.simulate.effects import Effects
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.spectrum import SpectrumSettings, render_spectra

SILENCE_DB = 99.0  # error of a receiver that loses everything
REQUIREMENT = re.compile(
    r"(coverage|csi|spectrum)\b\D*?(-?\d+(?:\.\d+)?)?\s*(?:dB)?", re.IGNORECASE
)
DEFAULTS = {"coverage": 1.0, "csi": 20.0, "spectrum": 0.9}  # where the text gives no number


@dataclass(frozen=True)
class Deliverable:
    """A requirement: kind of error, tolerance and share of receivers.

    >>> str(Deliverable.parse("csi -20 dB"))
    'channel NMSE at most -20 dB for 95% of the receivers'

    Attributes:
        kind: `coverage` (received power), `csi` (channel) or `spectrum`.
        tolerance: largest error: |dB| of received power; NMSE of the channel in dB; for spectra the
            error as a share of the error of taking the nearest other receiver's spectrum.
        quantile: share of the receivers for which it must hold.
    """

    kind: Literal["coverage", "csi", "spectrum"]
    tolerance: float
    quantile: float = 0.95

    @staticmethod
    def parse(text: str, quantile: float = 0.95) -> Deliverable:
        """Read text: `coverage +-1 dB`, `csi -20 dB`,
        `spectrum skill` (0.9 unless a number is given).

        Raises:
            ValueError: none of these.
        """
        match = REQUIREMENT.fullmatch(text.strip())
        if not match:
            expected = "'coverage +-1 dB', 'csi -20 dB' or 'spectrum skill 0.9'"
            raise ValueError(f"effects.deliverable={text!r}: expected {expected}")
        kind: Any = match[1].lower()
        number = float(match[2] or DEFAULTS[kind])
        if kind == "spectrum" and not 0 < number < 1:
            raise ValueError(f"effects.deliverable={text!r}: a skill lies between 0 and 1")
        # A skill of 0.9 is an error of 0.1; rounded, since 1 - 0.9 is not 0.1 in binary.
        tolerance = {
            "coverage": abs(number),
            "csi": -abs(number),
            "spectrum": round(1 - number, 6),
        }[kind]
        return Deliverable(kind, tolerance, quantile)

    def __str__(self) -> str:
        wanted = {
            "coverage": f"received power within +-{self.tolerance:g} dB",
            "csi": f"channel NMSE at most {self.tolerance:g} dB",
            "spectrum": f"spectrum skill at least {1 - self.tolerance:g} over the nearest "
            "receiver's",
        }
        return f"{wanted[self.kind]} for {self.quantile:.0%} of the receivers"


@dataclass(frozen=True)
class SurveyProbe:
    """A full simulation of some receivers, and how channels and spectra are made of it.

    Attributes:
        paths: everything on, R receivers.
        effects: what "everything" was.
        frequency_hz: (K,) subcarriers [Hz].
        wavelength: at the carrier [m].
        elements: (M, 3) [m] of the array that channels are measured with.
        spectrum: definition of spectra.
        nearest: paths of the nearest other receiver of each, (R receivers); needed for spectra
            only.
    """

    paths: TracedPaths
    effects: Effects
    frequency_hz: np.ndarray
    wavelength: float
    elements: np.ndarray
    spectrum: SpectrumSettings
    nearest: TracedPaths | None = None

    @cached_property
    def _channels(self) -> np.ndarray:
        """(R, ports x M, K), with everything."""
        return self._responses(self.paths)

    @cached_property
    def _images(self) -> tuple[np.ndarray, np.ndarray]:
        """With everything, and of the nearest other receivers."""
        if self.nearest is None:
            raise ValueError("spectra are compared with the nearest receiver's: trace it too")
        return self._render(self.paths), self._render(self.nearest)

    @property
    def reached(self) -> np.ndarray:
        """Receivers that at least one path reaches (R,) bool; the others are not evaluated."""
        return self.paths.received_power() > 0

    def lost_power_shares(self, remaining: Effects | TracedPaths) -> np.ndarray:
        """Return the share of each receiver's power that is lost (R,), negative where more arrives.

        Args:
            remaining: effects, here and below; or another trace of these receivers, of fewer rays.
        """
        full = self.paths.received_power()
        return 1 - self._rest(remaining).received_power() / np.where(full > 0, full, 1)

    def nmse(self, remaining: Effects | TracedPaths) -> np.ndarray:
        """Return the NMSE of each receiver's channel (R,), over all tones,
        elements and polarisations.
        """
        full, rest = self._channels, self._responses(self._rest(remaining))
        error = (np.abs(full[:, : rest.shape[1]] - rest) ** 2).sum((1, 2))
        # A polarisation that is left out is missed whole.
        error += (np.abs(full[:, rest.shape[1] :]) ** 2).sum((1, 2))
        energy = (np.abs(full) ** 2).sum((1, 2))
        return error / np.where(energy > 0, energy, 1)

    def errors(self, remaining: Effects | TracedPaths, deliverable: Deliverable) -> np.ndarray:
        """Return the deliverable's error at each receiver (R,), in the unit of its tolerance."""
        # Losing everything is infinite in decibels, and would spoil every quantile.
        least = from_decibels(-SILENCE_DB)
        if deliverable.kind == "coverage":
            return np.abs(to_decibels(np.maximum(1 - self.lost_power_shares(remaining), least)))
        if deliverable.kind == "csi":
            return to_decibels(np.maximum(self.nmse(remaining), least))
        full, near = self._images
        # With nothing left out the image is there already.
        image = full if remaining == self.effects else self._render(self._rest(remaining))
        error, nearest = (((other - full) ** 2).mean((1, 2)) for other in (image, near))
        return error / np.maximum(nearest, 1e-12)

    def _rest(self, remaining: Effects | TracedPaths) -> TracedPaths:
        # Nothing is traced again: without an effect the solver would draw other rays.
        return (
            remaining if isinstance(remaining, TracedPaths) else self.paths.keep_effects(remaining)
        )

    def _responses(self, paths: TracedPaths) -> np.ndarray:
        return paths.responses(self.frequency_hz, self.elements, self.wavelength)

    def _render(self, paths: TracedPaths) -> np.ndarray:
        return render_spectra(paths, self.spectrum, self.frequency_hz, self.wavelength)[0]


def list_removals(full: Effects) -> dict[str, Effects]:
    """Return what can be left out of `full`, one at a time: a mechanism, a depth,
    the second polarisation.

    >>> full = Effects(depth=2).switch_off("refraction", "diffraction", "diffuse")
    >>> list(list_removals(full))
    ['line_of_sight', 'specular', 'depth > 1', 'polarisation']
    """
    names = [*full.enabled, *(f"depth > {depth}" for depth in range(full.depth - 1, 0, -1))]
    names += ["polarisation"] if full.polarisation else []
    return {name: less for name in names if (less := _without(full, name)) is not None}


def list_effect_sets(full: Effects, removable: tuple[str, ...]) -> list[Effects]:
    """List every set of switches without some of `removable` (named as in `list_removals`);
    `full` first.
    """
    sets = {full}
    for name in removable:
        sets |= {less for less in (_without(effects, name) for effects in sets) if less is not None}
    return sorted(sets, key=lambda s: (-len(s.enabled), -s.depth, not s.polarisation))


def _without(effects: Effects, name: str) -> Effects | None:
    """None when nothing would be left."""
    if name.startswith("depth > "):
        return replace(effects, depth=min(effects.depth, int(name[8:])))
    try:
        return effects.switch_off(name)
    except ValueError:
        return None
