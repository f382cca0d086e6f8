"""Physical expectations of effects, printed beside the measured ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsparc.simulate.attribution import Probe


def reasons(
    probe: Probe, distances: np.ndarray, materials: Mapping[str, Mapping[str, Any]]
) -> dict[str, str]:
    """Why an effect should or should not matter, by its name; absent where there is no short one.

    Args:
        probe: everything on.
        distances: (R,) [m] between the ends.
        materials: of the scene; `permittivity`, `thickness_m` and `scattering` are read where given.
    """
    wavelength, paths = probe.wavelength, probe.paths
    distance = float(np.median(distances))
    sight = paths.per_receiver((paths.order == 0).astype(float)) > 0
    zone = f"first Fresnel zone {np.sqrt(wavelength * distance) / 2:.2g} m wide at {distance:.3g} m"
    rough = [m["scattering"] ** 2 for m in materials.values() if m.get("scattering")]
    found = {
        "line_of_sight": f"{sight.mean():.0%} of the receivers see the transmitter",
        "diffraction": f"{zone}; {1 - sight.mean():.0%} shadowed",
        "diffuse": f"smooth below {wavelength / 8 * 1e3:.2g} mm of relief (Rayleigh)"
        + (f"; S^2 is {min(rough):.1%} to {max(rough):.1%} of a reflection" if rough else ""),
    }
    losses = {name: _normal_incidence(m, wavelength) for name, m in materials.items() if _slab(m)}
    if losses:
        through = {f"{loss:.1f} dB ({name})": loss for name, (_, loss) in losses.items()}
        clearest, densest = min(through, key=through.__getitem__), max(through, key=through.__getitem__)
        found["refraction"] = f"a sheet costs {clearest} to {densest}"
        mirror = -10 * np.log10(np.median([10 ** (-loss / 10) for loss, _ in losses.values()]))
        found["depth"] = f"a reflection costs about {mirror:.0f} dB"
    return found


def _slab(material: Mapping[str, Any]) -> bool:
    # A conductor's permittivity is 1: its loss is not in this number.
    return float(material.get("permittivity", 0.0)) > 1.01 and float(material.get("thickness_m", 0.0)) > 0


def _normal_incidence(material: Mapping[str, Any], wavelength: float) -> tuple[float, float]:
    """Loss [dB] of a reflection off, and of a passage through, a lossless slab at normal incidence."""
    index = np.sqrt(float(material["permittivity"]))
    fresnel = (1 - index) / (1 + index)
    turn = np.exp(-4j * np.pi * index * float(material["thickness_m"]) / wavelength)
    through = (1 - fresnel**2) * np.sqrt(turn) / (1 - fresnel**2 * turn)
    back = 1 - abs(through) ** 2
    return -10 * np.log10(max(back, 1e-9)), -20 * np.log10(max(abs(through), 1e-9))
