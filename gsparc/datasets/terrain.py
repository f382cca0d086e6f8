"""Levels that a terrain lets through, before any row: the Irregular Terrain Model over a raster of
heights (itmlogic).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.errors import DataError
from gsparc.data.schema import Measurements
from gsparc.datasets.rasters import read_raster
from gsparc.physics.waves import LIGHT

SQUARES, LEAST = 20_000, 2_000  # that levels are kept of, about the rows; of each of many stations
LOWEST_M = 0.5  # antenna above ground that the model is meant for
STEPS = 150  # of a profile at most
NEAR = 4  # heights that tell of a place
AROUND = 0.2  # of the longer side of the rows' box, on each side of it
CLOSE_M = 1e-3
REACH_M = 10.0  # shortest path
# Average ground (permittivity, conductivity [S/m]) and air (refractivity at the surface), vertical
# polarisation: the defaults of the model's own programs
GROUND, AIR = (15.0, 0.005), 314.0


def terrain_levels(
    path: Path,
    data: Measurements,
    crs: str | None = None,
    nodata: float | str | None = None,
    tx_m: float | None = None,
    rx_m: float | None = None,
    mhz: float | None = None,
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, places (M, 2) [m] and levels (M,) [dB] of each station: minus the model's loss.

    Args:
        path: raster of heights [m], see `read_raster`, which takes crs and nodata.
        data: measurements about which the levels are wanted.
        tx_m, rx_m: heights of the antennas above ground [m]; None: those of the measurements, whose
            ground is then zero.
        mhz: the carrier; None: of the measurements.

    Raises:
        DataError: no itmlogic, no carrier, no heights about the rows, or no place of the only
            station; of several those without are left out.
    """
    site, origin = data.site, data.site.origin
    carriers = site.every_station.carrier_hz
    raster = read_raster(path, crs, nodata)
    points, ground = raster.locate(site.georeference, path), raster.bands[0]
    points, ground = points[np.isfinite(ground)], ground[np.isfinite(ground)]
    tree, at = cKDTree(points), data.moving[:, :2] + origin[:2]
    margin = AROUND * float(np.ptp(at, axis=0).max())
    about = ((points >= at.min(0) - margin) & (points <= at.max(0) + margin)).all(1)
    if not about.any():
        raise DataError(f"model.prior={path}: no height is known about the rows")
    count = max(SQUARES // len(site.every_station), LEAST)
    side = math.sqrt(float(np.prod(np.ptp(points[about], axis=0))) / count) or 1.0
    chosen = np.unique(np.round(points[about] / side), axis=0, return_index=True)[1]
    squares = points[about][chosen]
    spacing = float(np.median(tree.query(squares, 2)[0][:, 1]))
    stood, moved = (tx_m, rx_m) if site.moving_end == "rx" else (rx_m, tx_m)
    moved = float(np.median(data.moving[:, 2]) + origin[2]) if moved is None else moved
    for number, still in enumerate(site.every_station.position + origin):
        carrier = site.carrier_hz if carriers is None else float(carriers[number])
        carrier = carrier if mhz is None else mhz * 1e6
        known = np.isfinite(still).all()
        if carrier is None or not (known or site.several):
            raise DataError(
                f"model.prior=itm:{path}: the place of {site.every_station.shown[number]} and the "
                "carrier are needed (mhz: NUMBER beside itm)"
            )
        if not known:
            continue
        above = float(still[2]) if stood is None else stood
        heights, level = (max(above, LOWEST_M), max(moved, LOWEST_M)), list[float]()
        for end in squares:
            profile = _profile(tree, ground, still[:2], end, spacing)
            level.append(-longley_rice_loss(*profile, heights, carrier / 1e6))
        yield site.every_station.shown[number] if site.several else "", squares, np.array(level)


def _profile(
    tree: cKDTree, ground: np.ndarray, start: np.ndarray, end: np.ndarray, spacing: float
) -> tuple[np.ndarray, float]:
    """Heights (n,) [m] along a path, of the nearest points, and their distance [m]."""
    length = max(float(np.linalg.norm(end - start)), REACH_M)
    steps = int(np.clip(math.ceil(length / spacing), 2, STEPS))
    along = start + np.linspace(0, 1, steps + 1)[:, None] * (end - start)
    away, near = tree.query(along, NEAR)
    weight = 1 / (away + CLOSE_M) ** 2
    return (weight * ground[near]).sum(1) / weight.sum(1), length / steps


def longley_rice_loss(
    profile_m: np.ndarray, step_m: float, heights_m: tuple[float, float], mhz: float
) -> float:
    """Return the loss [dB] between isotropic antennas by the Irregular Terrain Model, version 1.2.2
    (Hufford 1995): of free space and its reference attenuation.

    It is meant for 20 MHz to 20 GHz, antennas .5 to 3,000 m above ground and paths from 1 km on.

    Args:
        profile_m: (n,) heights of the ground from one antenna to the other [m].
        step_m: between them [m].
        heights_m: of the antennas above ground [m].
        mhz: carrier [MHz].
    """
    try:
        from itmlogic.preparatory_subroutines.qlrpfl import qlrpfl
        from itmlogic.preparatory_subroutines.qlrps import qlrps
    except ImportError:
        raise DataError("model.prior=itm: needs itmlogic; pip install 'gsparc[itm]'") from None
    wave, curvature, air, impedance = qlrps(mhz, 0.0, AIR, 1, *GROUND)
    path = {
        "pfl": [len(profile_m) - 1, step_m, *profile_m.tolist()],
        "hg": [*heights_m],
        "wn": wave,
        "gme": curvature,
        "ens": air,
        "zgnd": impedance,
        **{"lvar": 0, "mdvarx": -1, "klimx": 0, "kwx": 0},
    }
    length = step_m * (len(profile_m) - 1)
    free = 20 * math.log10(4 * math.pi * length * mhz * 1e6 / LIGHT)
    return free + max(float(qlrpfl(path)["aref"]), 0.0)
