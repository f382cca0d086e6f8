"""Warnings about places that other units explain: millimetres, kilometres, degrees."""

from __future__ import annotations

import numpy as np

from gsparc.data.outliers import find_gap
from gsparc.data.schema import Measurements

TINY_DEGREES = 1.0  # a campaign's extent in degrees
# Heights 100 m apart, or a width of 10 km, are rarer than wrong units, as is a box of a centimetre
HIGHEST, WIDEST, NARROWEST = 100.0, 1e4, 0.01


def unit_warnings(data: Measurements) -> list[str]:
    """Warn of readable but implausible places: of all, else of the end that moves,
    as a static end elsewhere widens the box.
    """
    if not np.ptp(data.moving, axis=0).any():
        return ["all positions are the same, a box of 0 m: is it the moving end's column?"]
    if data.site.georeference is not None:  # degrees became metres: no unit to mistake
        return _group_hints(data.moving)
    ends = np.concatenate([data.tx, data.rx_position]) + data.site.origin
    places = ends[np.isfinite(ends).all(axis=1)], data.moving[:, :3] + data.site.origin
    return next(filter(None, map(_position_hints, places)), [])


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
