"""Where transmitters stand, how their antennas radiate, and sectors of one mast."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsparc.base.instantiate import from_settings
from gsparc.base.limits import Checked, Limit, choice, finite_array, or_null, setting, whole
from gsparc.data.georeference import Georeference

NUMBERS = Limit(
    "a list of two or three finite numbers", lambda v: finite_array(v).shape in ((2,), (3,))
)
# Sionna's; the last is 3GPP TR 38.901, table 7.3-1
PATTERNS = ("iso", "dipole", "hw_dipole", "tr38901")


@dataclass(frozen=True)
class Antenna:
    """What a transmitter radiates, vertically polarised.

    Attributes:
        pattern: one of `PATTERNS`.
        azimuth_deg: of its boresight, from x counter-clockwise.
        downtilt_deg: of its boresight below the horizon.
    """

    pattern: str = "iso"
    azimuth_deg: float = 0.0
    downtilt_deg: float = 0.0


ISOTROPIC = Antenna()


@dataclass(frozen=True)
class Transmitter:
    """One station.

    Attributes:
        name: in the file.
        position: (3,) [m], world.
        antenna: its pattern and where it looks.
    """

    name: str
    position: np.ndarray
    antenna: Antenna = ISOTROPIC


@dataclass(frozen=True)
class Mast(Checked):
    """An entry of `scene.transmitters`.

    Attributes:
        name: None: numbered.
        position_m: [x, y, z] in the world.
        position_deg: [latitude, longitude] or [latitude, longitude, z] instead, of scenes on Earth.
        height_m: above what is there, a roof or the ground.
        pattern: one of `PATTERNS`; None: `iso`, or `tr38901` of sectors.
        azimuth_deg, downtilt_deg: see `Antenna`; of the first sector.
        sectors: antennas at equal angles around the mast, each a station.
    """

    name: str | None = None
    position_m: Sequence[float] | None = setting(None, or_null(NUMBERS))
    position_deg: Sequence[float] | None = setting(None, or_null(NUMBERS))
    height_m: float | None = None
    pattern: str | None = setting(None, or_null(choice(*PATTERNS)))
    azimuth_deg: float = 0.0
    downtilt_deg: float = 0.0
    sectors: int = setting(1, whole(1, 12))


def place_transmitters(
    entries: Sequence[Mapping[str, Any]],
    surface: Callable[[np.ndarray], np.ndarray] | None,
    georeference: Georeference | None,
) -> list[Transmitter]:
    """Return all sectors of all entries of `scene.transmitters`.

    Args:
        entries: settings of `Mast`.
        surface: (n, 2) [m] -> (n,) [m] height of what is there; None where a scene has no such
            thing.
        georeference: of the world's origin; None where the scene is nowhere on Earth.

    Raises:
        ValueError: an entry with an unknown setting, without a place, or two of one name.
    """
    transmitters: list[Transmitter] = []
    for number, entry in enumerate(entries):
        where = f"scene.transmitters[{number}]"
        mast = from_settings(Mast, entry, where)
        # Isotropic sectors of a mast would all be the same station.
        pattern = mast.pattern or ("tr38901" if mast.sectors > 1 else "iso")
        position = _position(mast, where, surface, georeference)
        name = mast.name or f"tx{number}"
        for sector in range(mast.sectors):
            azimuth = (mast.azimuth_deg + 360 * sector / mast.sectors) % 360
            label = name if mast.sectors == 1 else f"{name}-{sector + 1}"
            transmitters.append(
                Transmitter(label, position, Antenna(pattern, azimuth, mast.downtilt_deg))
            )
    names = [transmitter.name for transmitter in transmitters]
    # Files tell stations apart by their names.
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"scene.transmitters: {twice[0]!r} twice; expected a name for each")
    return transmitters


def _position(
    mast: Mast,
    where: str,
    surface: Callable[[np.ndarray], np.ndarray] | None,
    georeference: Georeference | None,
) -> np.ndarray:
    """(3,) [m], world."""
    names = [n for n in ("position_m", "position_deg") if getattr(mast, n) is not None]
    if len(names) != 1:
        raise ValueError(f"{where}: give position_m=[x,y,z] or position_deg=[latitude,longitude]")
    values = np.array(getattr(mast, names[0]), dtype=np.float64)
    if names[0] == "position_deg":
        if georeference is None:
            raise ValueError(
                f"{where}.position_deg: this scene is nowhere on Earth; give position_m"
            )
        values = np.append(georeference.from_degrees(values[:1], values[1:2])[0], values[2:])
    if len(values) == 3:
        return values
    if mast.height_m is None or surface is None:
        raise ValueError(
            f"{where}: give height_m, above what stands there, or three coordinates in metres"
        )
    return np.append(values, surface(values[None])[0] + mast.height_m)
