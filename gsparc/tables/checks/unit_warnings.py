"""Warnings about places, arrays and grids that other units explain: millimetres, degrees."""

from __future__ import annotations

import numpy as np

from gsparc.data.outliers import find_gap
from gsparc.data.schema import Measurements

LONG_ARRAY = 100  # wavelengths: no array of one receiver
ROUNDED = 0.02  # of a circle
TINY_DEGREES = 1.0  # a campaign's extent in degrees
# Heights 100 m apart, or a width of 10 km, are rarer than wrong units, as is a box of a centimetre
HIGHEST, WIDEST, NARROWEST = 100.0, 1e4, 0.01


def unit_warnings(data: Measurements) -> list[str]:
    """Warn of readable but implausible places, arrays and grids. Places are those of both ends,
    else of the one that moves, as a static end elsewhere widens the box.
    """
    site = data.site
    if not np.ptp(data.moving, axis=0).any():
        hints = ["all positions are the same, a box of 0 m: is it the moving end's column?"]
    elif site.georeference is not None:  # degrees became metres: no unit to mistake
        hints = _group_hints(data.moving)
    else:
        ends = np.concatenate([data.tx, data.rx_position]) + site.origin
        places = ends[np.isfinite(ends).all(axis=1)], data.moving[:, :3] + site.origin
        hints = next(filter(None, map(_position_hints, places)), [])
    reach = 0.0 if site.array is None else float(np.ptp(site.array, axis=0).max())
    if reach > LONG_ARRAY * (site.wavelength or np.inf):
        hints = [*hints, f"the antennas reach over {reach:.4g} m: in mm?"]
    turn = 0.0 if site.grid is None else site.grid.azimuth_step * site.grid.width
    # Steps in radians taken for degrees: the columns then span 2 pi degrees.
    if abs(np.degrees(turn) / (2 * np.pi) - 1) < ROUNDED:
        hints = [*hints, "the columns span a full circle in radians; convert grid_deg"]
    return hints


def _position_hints(positions: np.ndarray) -> list[str]:
    """Warnings that positions (n, 3), in the world, may not be metres."""
    extent, middle = np.ptp(positions, axis=0), np.abs(np.median(positions[:, :2], axis=0))
    width, across = float(extent.max()), float(extent[:2].max())
    reach = np.abs(positions[:, :2]).max(axis=0)
    on_earth = reach.max() <= 180 and reach.min() <= 90
    # Metres about a local origin lie near it; degrees of a small site lie many of its widths away.
    if on_earth and across < TINY_DEGREES and middle.min() > 5 * across and middle.max() > 10:
        near = f"({positions[0, 0]:.6g}, {positions[0, 1]:.6g})"
        how = "then give them as latitude and longitude (columns of a table: "
        how += "dataset.columns.lat=HEAD, .lon)"
        return [f"positions near {near} within {across:.2g}: degrees? {how}"]
    if groups := _group_hints(positions):
        return groups
    # Survey tools print millimetres as whole numbers; metres come with decimals.
    printed = across > WIDEST / 10 and bool((positions % 1 == 0).all())
    if not (extent[2] > HIGHEST or width > WIDEST or printed or width < NARROWEST):
        return []
    size = " x ".join(f"{side:.4g}" for side in extent)
    units = "kilometres" if width < NARROWEST else "millimetres, centimetres or feet"
    return [f"places fill a box of {size}: in {units}? convert them to metres"]


def _group_hints(positions: np.ndarray) -> list[str]:
    """A warning of two groups of positions (n, 3) far apart."""
    causes = "lost digits, latitude and longitude exchanged in some rows, zones of a projection "
    causes += "(give degrees), or two sites (a file for each)?"
    groups = find_gap(positions[:, :2])
    return (
        [] if groups is None else [f"two groups of places {groups[1] / 1e3:.4g} km apart: {causes}"]
    )
