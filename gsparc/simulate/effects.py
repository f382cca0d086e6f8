"""Propagation effects of a simulator as switches, and which of them a path needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsparc.base.instantiate import from_settings
from gsparc.base.limits import Checked, setting, whole

# Bits of one interaction; the first four are Sionna's, an edge is a wedge with one face.
SPECULAR, DIFFUSE, REFRACTION, DIFFRACTION, EDGE = 1, 2, 4, 8, 16

BITS = {
    "specular": SPECULAR,
    "refraction": REFRACTION,
    "diffraction": DIFFRACTION,
    "edge_diffraction": EDGE,
    "diffuse": DIFFUSE,
}
MECHANISMS = ("line_of_sight", *BITS)


@dataclass(frozen=True)
class Effects(Checked):
    """What is simulated; off means not computed.

    Attributes:
        line_of_sight: the straight path through air.
        specular: mirror reflection.
        refraction: transmission through sheets (the straight path through a pane is one).
        diffraction: at wedges between two faces.
        edge_diffraction: at free edges of a sheet; needs `diffraction`.
        diffuse: scattering off rough surfaces; needs `specular`.
        depth: most interactions of a path.
        polarisation: receive the horizontal component beside the vertical one; off: the vertical
            one only.
        noise_snr_db: white noise on channels this far below their mean power [dB]; None for none.
    """

    line_of_sight: bool = True
    specular: bool = True
    refraction: bool = True
    diffraction: bool = True
    edge_diffraction: bool = True
    diffuse: bool = True
    depth: int = setting(3, whole(0, 8))
    polarisation: bool = True
    noise_snr_db: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.diffuse and not self.specular:
            raise ValueError(
                "effects.diffuse needs effects.specular (the solver loses diffuse power without)"
            )
        if self.edge_diffraction and not self.diffraction:
            raise ValueError("effects.edge_diffraction needs effects.diffraction")
        if not any(getattr(self, name) for name in MECHANISMS):
            raise ValueError("effects: every mechanism is off; nothing would arrive")

    @property
    def enabled(self) -> tuple[str, ...]:
        """Names of the mechanisms that are computed."""
        return tuple(name for name in MECHANISMS if getattr(self, name))

    def switch_off(self, *names: str) -> Effects:
        """Return the same with some switched off, and with what needs them.

        >>> Effects().switch_off("diffraction").enabled  # edges need it
        ('line_of_sight', 'specular', 'refraction', 'diffuse')
        """
        needs = {"specular": "diffuse", "diffraction": "edge_diffraction"}
        off = {*names, *(needs[name] for name in names if name in needs)}
        return replace(self, **dict.fromkeys(off, False))

    def allows_paths(self, mechanisms: np.ndarray, order: np.ndarray) -> np.ndarray:
        """Tell which paths exist under these switches: (P,) bool.

        >>> kept = Effects(refraction=False, depth=2)
        >>> kinds = np.array([0, SPECULAR, REFRACTION, SPECULAR], np.uint8)
        >>> kept.allows_paths(kinds, np.array([0, 1, 1, 3]))
        array([ True,  True, False, False])

        Args:
            mechanisms: (P,) OR of the bits of all interactions of a path.
            order: (P,) number of interactions.
        """
        bits = sum(bit for name, bit in BITS.items() if getattr(self, name))
        # No interaction of a path may be of a kind that is off; order 0 is the line of sight.
        allowed = (mechanisms & ~np.array(bits, dtype=mechanisms.dtype)) == 0
        return allowed & (order <= self.depth) & (self.line_of_sight | (order > 0))

    def __str__(self) -> str:
        extra = [f"depth {self.depth}"] + (["both polarisations"] if self.polarisation else [])
        return ", ".join([name.replace("_", " ") for name in self.enabled] + extra)


def from_config(config: Mapping[str, Any]) -> Effects:
    """Return switches from the config group `effects`.

    Raises:
        ValueError: a switch that does not exist, or a contradiction.
    """
    return from_settings(Effects, config, "effects", "effect")
