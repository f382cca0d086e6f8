"""Warnings about values that other units explain: millimetres, degrees, radians,
linear powers as dB.
"""

from __future__ import annotations

import numpy as np

from gsparc.data.outliers import find_gap
from gsparc.data.schema import Measurements

TINY_DEGREES = 1.0  # a campaign's extent in degrees
LONG_ARRAY = 100  # wavelengths: no array of one receiver
LEAST, FEW = 3, 0.02  # places, and their share of all, that tell a unit of their own
SPOT = 100  # of a box's width, what places in kilometres take among metres
NEAR = 3  # widths of a box, about it
DEGREE_M = 111e3
NARROW_DB = 1.0  # between all levels of a site there is more
HERTZ = 3e6, 1e12  # of carriers that links are measured at


def unit_warnings(data: Measurements) -> list[str]:
    """Warn of readable but implausible values: millimetres, radians, linear powers given as dB."""
    site, ends = data.site, np.concatenate([data.tx, data.rx_position]) + data.site.origin
    if not np.ptp(data.moving, axis=0).any():
        hints = ["all positions are the same, a box of 0 m: is it the moving end's column?"]
    elif site.georeference is not None:  # degrees became metres: no unit to mistake
        hints = _group_hints(data.moving)
    else:
        # Both ends first; then the moving one alone, as a static end elsewhere widens the box.
        places = ends[np.isfinite(ends).all(axis=1)], data.moving[:, :3] + site.origin
        hints = next(filter(None, map(_position_hints, places)), [])
        still = (
            np.zeros((0, 2))
            if site.stations is None
            else site.stations.position[:, :2] + site.origin[:2]
        )
        mixed = {"rows": _find_other_unit(places[1][:, :2]), "stations": _find_other_unit(still)}
        hints = [f"of {who} {hint}" for who, hint in mixed.items() if hint] or hints
        if not site.target.is_complex:  # an array's antennas stand close together
            hints += _compare_reaches(still, places[1][:, :2])
    if site.array is not None and site.wavelength is not None:
        reach = float(np.ptp(site.array, axis=0).max())
        if reach > LONG_ARRAY * site.wavelength:
            waves = f"{reach / site.wavelength:.3g} wavelengths"
            hints.append(f"the antennas reach over {reach:.4g} m, {waves}: in mm?")
    hertz = site.carriers[np.isfinite(site.carriers)]
    if len(hertz) and not (HERTZ[0] <= hertz.min() and hertz.max() <= HERTZ[1]):
        hints.append(
            f"carriers of {hertz.min() / 1e6:g} to {hertz.max() / 1e6:g} MHz: another unit?"
        )
    if site.grid is not None:
        turn = np.degrees(site.grid.azimuth_step * site.grid.width)
        # Steps in radians taken for degrees: the columns then span 2 pi degrees.
        if abs(turn / (2 * np.pi) - 1) < 0.02:
            hints.append(
                f"the columns span {turn:.3g} degrees, a full circle in radians; convert grid_deg"
            )
    if site.target.is_level and (data.target > 0).all():
        spread = 10 * float(np.log10(data.target.max() / data.target.min()))
        # Linear powers taken for dB are all next to 0 dB: 10^(1e-9 / 10) is 1;
        # so are hundredths of decibels.
        if 0 < spread < NARROW_DB and len(np.unique(data.target)) >= LEAST:
            hints.append(
                f"the powers differ by {spread:.1g} dB in all; if they are linear, call them rssi"
            )
    return hints


def _position_hints(positions: np.ndarray) -> list[str]:
    """Warnings that positions (n, 3), in the world, may not be metres."""
    extent, middle = np.ptp(positions, axis=0), np.abs(np.median(positions[:, :2], axis=0))
    height, width, across = float(extent[2]), float(extent.max()), float(extent[:2].max())
    reach = np.abs(positions[:, :2]).max(axis=0)
    on_earth = reach.max() <= 180 and reach.min() <= 90
    # Metres about a local origin lie near it; degrees of a small site lie many of its widths away.
    if on_earth and across < TINY_DEGREES and middle.min() > 5 * across and middle.max() > 10:
        near = f"({positions[0, 0]:.6g}, {positions[0, 1]:.6g})"
        how = (
            "then give them as latitude and longitude (columns of a table: "
            "dataset.columns.lat=HEAD, .lon)"
        )
        return [f"positions near {near} within {across:.2g}: degrees? {how}"]
    if groups := _group_hints(positions):
        return groups
    # Heights 100 m apart, or a width of 10 km, are rarer than wrong units.
    if height > 100 or width > 1e4:
        unit, factor = (
            ("millimetres", 1e-3) if height > 1000 or width > 1e4 else ("centimetres", 1e-2)
        )
        size = " x ".join(f"{e * factor:.3g}" for e in extent)
        hint = f"if these are {unit}, the box is {size} m: convert to metres"
        far = (
            f"heights differ by {height:.4g} m"
            if height > 100
            else (f"positions reach over {width:.4g} m")
        )
        return [f"{far}; {hint}"]
    # Survey tools print millimetres as whole numbers; metres come with decimals.
    if across > 1000 and (positions % 1 == 0).all():
        size = " x ".join(f"{e / 1000:.4g}" for e in extent)
        finding = f"positions are whole numbers up to {across:.0f} apart"
        return [f"{finding}: millimetres? the box is {size} m then"]
    if 0 < width < 0.01:
        return [
            f"everything lies within {width * 1e3:.2g} mm; if these are kilometres, convert "
            "to metres"
        ]
    return []


def _group_hints(positions: np.ndarray) -> list[str]:
    """A warning of two groups of positions (n, 3) far apart."""
    causes = (
        "lost digits, latitude and longitude exchanged in some rows, zones of a projection (give "
    )
    causes += "degrees), or two sites (a file for each)?"
    groups = find_gap(positions[:, :2])
    return (
        [] if groups is None else [f"two groups of places {groups[1] / 1e3:.4g} km apart: {causes}"]
    )


def _find_other_unit(places: np.ndarray) -> str:
    """Name the unit of some of places (n, 2), which lie in a spot as others lie in metres; empty:
    none.
    """
    places = np.unique(places[np.isfinite(places).all(axis=1)], axis=0)
    if len(places) < 2 * LEAST:
        return ""
    side = float(np.ptp(places, axis=0).max()) / SPOT
    which, counts = np.unique(
        np.floor(places / side), axis=0, return_inverse=True, return_counts=True
    )[1:]
    middle = np.median(places[which.reshape(-1) == counts.argmax()], axis=0)
    near = (np.abs(places - middle) < side).all(axis=1)
    spot, rest = places[near], places[~near]
    if min(len(spot), len(rest)) < max(LEAST, FEW * len(places)):
        return ""
    small, wide = (float(np.ptp(some, axis=0).max()) for some in (spot, rest))
    kilometres = wide < 3e3 * small < 9 * wide and _are_thousandths(spot, rest, 0.5).all()
    if kilometres or (wide < 3 * DEGREE_M * small < 9 * wide and np.abs(spot).max() <= 180):
        text = (
            f"{len(spot)} of {len(places)} places lie within {small:.2g} m, the others over "
            f"{wide:.4g} m: "
        )
        return f"{text}in {'kilometres' if kilometres else 'degrees'}? give all of them in one unit"
    return ""


def _are_thousandths(places: np.ndarray, others: np.ndarray, beyond: float) -> np.ndarray:
    """Tell along which axes places (n, 2), times 1000, lie where others (m, 2) do,
    or widths beyond (2,).
    """
    least, most = others.min(axis=0), others.max(axis=0)
    around, (low, high) = most - least, (1e3 * places.min(axis=0), 1e3 * places.max(axis=0))
    inside = (low > least - beyond * around) & (high < most + beyond * around)
    return np.asarray(inside & (SPOT * np.ptp(places, axis=0) < around))


def _compare_reaches(still: np.ndarray, moving: np.ndarray) -> list[str]:
    """Name axes along which stations (T, 2), or rows (n, 2),
    lie where the others do in thousandths.
    """
    still, hints = np.unique(still[np.isfinite(still).all(axis=1)], axis=0), []
    for places, other, who in ((still, moving, "stations"), (moving, still, "rows")):
        if len(still) >= LEAST and (small := _are_thousandths(places, other, NEAR)).any():
            reach, wide = (float(np.ptp(some[:, small], axis=0).max()) for some in (places, other))
            axes = " and ".join(np.array(["x", "y"])[small])
            hints += [
                f"{axes} of {who} reach over {reach:.3g} m, the others over {wide:.4g}: in "
                "kilometres?"
            ]
    return hints
