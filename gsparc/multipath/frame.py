"""From local metres and stored units to those that sources are found in, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torch import Tensor

from gsparc.data.schema import Site
from gsparc.multipath.rows import Rows


@dataclass(frozen=True)
class Frame:
    """How local metres and stored units become the search's.

    Attributes:
        middle: (3,) float64 [m], local; the search works about it.
        scale: stored target = scale * search target.
        carrier_hz: amplitude goes with wavelength, so targets are multiplied by f / carrier first [Hz].
    """

    middle: Tensor
    scale: float
    carrier_hz: float

    def inside(self, rows: Rows) -> Rows:
        """Rows in local metres and stored units, as the search wants them."""
        flat = rows.target * (rows.frequency / self.carrier_hz)[:, None].float() / self.scale
        return replace(rows.moved(-self.middle), target=flat)


def frame_of(site: Site, rows: Rows) -> Frame:
    """Where these rows have their middle and unit power.

    Raises:
        ValueError: every channel is silent.
    """
    frequency = site.tones()
    carrier = float(frequency.mean()) if site.carrier_hz is None else float(site.carrier_hz)
    power = (rows.target * (rows.frequency / carrier)[:, None].float()).abs().square().mean()
    if not power > 0:
        raise ValueError(f"{site.name}: every channel to learn from is silent, no source can be found")
    return Frame(rows.position.mean(0), max(math.sqrt(float(power)), 1e-30), carrier)


def refuse(site: Site, name: str, antennas: int = 1) -> None:
    """ValueError, in the name of a method, where sources with carrier phase explain nothing."""
    if site.kind != "csi":
        raise ValueError(f"{name}: needs complex channels (csi), {site.name} has {site.kind}; take model=gp")
    if site.static_position is None:
        raise ValueError(f"{name}: {site.name} does not say where its static end is; take model=complex_gp")
    if site.static_end == "rx" and antennas > 1:
        raise ValueError(
            f"{name}: in {site.name} the transmitter moves before {antennas} antennas; take one of them"
        )
