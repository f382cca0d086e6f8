"""Normalisation of positions and targets for fitting, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torch import Tensor

from gsparc.data.schema import Site
from gsparc.multipath.rows import Rows


@dataclass(frozen=True)
class Frame:
    """Offset and scale between local metres and stored units, and those of the fit.

    Attributes:
        middle: (3,) float64 [m], local; origin of the fit.
        scale: stored target = scale * normalised target.
        carrier_hz: amplitude goes with wavelength, so targets are multiplied by f / carrier first [Hz].
    """

    middle: Tensor
    scale: float
    carrier_hz: float

    def inside(self, rows: Rows) -> Rows:
        """Rows in local metres and stored units, normalised."""
        flat = rows.target * (rows.frequency / self.carrier_hz)[:, None].float() / self.scale
        return replace(rows.moved(-self.middle), target=flat)


def frame_of(site: Site, rows: Rows) -> Frame:
    """Frame in which these rows have zero mean position and unit power.

    Raises:
        ValueError: every channel is zero.
    """
    frequency = site.tones()
    carrier = float(frequency.mean()) if site.carrier_hz is None else float(site.carrier_hz)
    power = (rows.target * (rows.frequency / carrier)[:, None].float()).abs().square().mean()
    if not power > 0:
        raise ValueError(f"{site.name}: every training channel is zero, no source can be found")
    return Frame(rows.position.mean(0), max(math.sqrt(float(power)), 1e-30), carrier)


def refuse(site: Site, name: str, antennas: int = 1) -> None:
    """`ValueError`, in the name of a method, for data that sources with carrier phase cannot explain."""
    if site.kind != "csi":
        raise ValueError(f"{name}: needs complex channels (csi), {site.name} has {site.kind}; take model=gp")
    if site.static_position is None:
        raise ValueError(f"{name}: {site.name} does not say where its static end is; take model=complex_gp")
    if site.static_end == "rx" and antennas > 1:
        raise ValueError(
            f"{name}: in {site.name} the transmitter moves before {antennas} antennas; take one of them"
        )
