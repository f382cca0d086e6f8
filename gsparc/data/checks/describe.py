"""Sentences about measurements, and warnings about implausible values."""

from __future__ import annotations

import numpy as np

from gsparc.data.checks import outliers
from gsparc.data.checks.coherence import estimate_coherence
from gsparc.data.errors import list_first
from gsparc.data.load import split_for
from gsparc.data.schema import ENDS, Measurements, Site
from gsparc.data.spacing import neighbour_distance
from gsparc.data.splits import Split
from gsparc.ops import SphereGrid

TINY_DEGREES = 1.0  # a campaign's extent in degrees
LONG_ARRAY = 100  # wavelengths: no array of one receiver


def describe(data: Measurements) -> list[tuple[str, str]]:
    """Return (topic, sentence) pairs about a dataset; topics of what it has none of are left out."""
    site, phases, own, error = (
        data.site,
        estimate_coherence(data),
        data.release_split,
        data.site.convergence_error,
    )
    tones = np.zeros(1) if site.subcarriers_hz is None else site.subcarriers_hz
    weak, strong = (int((data.censored_side(np.arange(len(data))) == side).sum()) for side in (1, -1))
    paths, scale = data.directions, site.target_scale
    lines = [
        ("name", site.name + (f" (SIMULATED, stands in for {site.stand_in})" if site.stand_in else "")),
        ("kind", f"{site.kind}: {_targets(data)}"),
        ("stays", _static(site)),
        ("moves", _moving(data)),
        ("neighbours", spacing_words(distinct_places(data), site.wavelength)),
        *(("units?", hint) for hint in suspicious_values(data)),
        *(("outliers?", warning) for warning in outliers.outlier_warnings(data)),
        ("carrier", _carrier(site)),
        ("band", f"{len(tones)} subcarriers over {np.ptp(tones) / 1e6:.6g} MHz" if len(tones) > 1 else ""),
        ("grid", "" if site.grid is None else _grid(site.grid)),
        ("array", "" if site.array is None else f"{len(site.array)} receive antennas"),
        ("scale", "" if scale == 1 else f"stored targets are the measurements divided by {scale:.4g}"),
        ("censored", f"of {len(data)} powers {weak} lie under a level (unheard, unlisted), {strong} above one"
         if data.censored is not None else ""),
        ("runs", "" if data.run is None else f"{data.run.max() + 1}, each with an unknown complex factor"),
        ("phases", "" if phases is None else str(phases)),
        ("mask", f"{data.mask.mean():.1%} of the entries were measured"
         if data.mask is not None and data.censored is None else ""),
        ("directions", "" if paths is None else f"{sum(map(len, paths))} directions of arrival"),
        ("split", "" if own is None else f"its own: {len(own[0])} rows to train, {len(own[1])} to test"),
        ("split?", propose_split(data)),
        ("convergence", "" if error is None else f"solver error (NMSE between two seeds) {error:.3g}"),
        ("sha256", site.sha256),
    ]  # fmt: skip
    return [(topic, sentence) for topic, sentence in lines if sentence]


def summarise(data: Measurements, split: Split) -> list[tuple[str, str]]:
    """Return five (topic, sentence) pairs about a dataset and how a run divides it."""
    count = len(split.folds)
    whole = [sum(len(getattr(fold, part)) for fold in split.folds) for part in ("train", "val", "test")]
    train, val, test = (round(rows / count) for rows in whole)
    folds = f"each of {count} folds has about " if count > 1 else ""
    rows = f"{folds}{train} training, {val} validation and {test} test rows"
    if split.name == "none":
        rows = f"all {train + val} rows are learned from ({val} decide where a method has choices)"
    return [
        ("data", f"{data.site.name}, {data.site.kind}: {_targets(data)}"),
        ("stays", _static(data.site)),
        ("moves", _moving(data)),
        ("carrier", _carrier(data.site)),
        ("split", f"{split.name}: {rows}"),
    ]


def _carrier(site: Site) -> str:
    if site.carrier_hz is None:
        return "unknown; give frequency_hz, and effects that need the phase become available"
    return f"{site.carrier_hz / 1e9:.6g} GHz, wavelength {site.wavelength:.4g} m"


def distinct_places(data: Measurements) -> np.ndarray:
    """Return places (n, 3) or (n, 6) [m], one of each visit."""
    return data.moving if data.place is None else data.moving[np.unique(data.place, return_index=True)[1]]


def _targets(data: Measurements) -> str:
    count, shape = len(data), data.target.shape[1:]
    if data.site.kind == "spectrum":
        return f"{count} images of {shape[0]} x {shape[1]} directions"
    if data.site.kind == "csi":
        many = ["s" * (n != 1) for n in shape]
        return f"{count} channels of {shape[0]} antenna{many[0]} x {shape[1]} subcarrier{many[1]}"
    return f"{count} received powers"


def spacing_words(positions: np.ndarray, wavelength: float | None) -> str:
    """Say how far places (n, 3) [m] are from the nearest other, in metres and wavelengths."""
    different, counts = np.unique(positions, axis=0, return_counts=True)
    if len(different) < 2:
        return "one place alone"
    distance, same = neighbour_distance(different), int(counts[counts > 1].sum())
    text = f"the nearest other place is {distance:.3g} m away (median)"
    text += "" if wavelength is None else f", {distance / wavelength:.2g} wavelengths"
    return text + (f"; {same} rows share their place with another" if same else "")


def _static(site: Site) -> str:
    """Which end stands still, and where in the world."""
    if site.static_end is None:
        return "neither end"
    end, stations = ENDS[site.static_end], site.stations
    if stations is not None and (len(stations) > 1 or site.static_position is None):
        known = stations.position[np.isfinite(stations.position).all(axis=1)]
        lost = len(stations) - len(known)
        where = _box(known) if len(known) else ""
        where += f", {lost} of them at unknown places" if lost else ""
        count = f"{len(stations)} station{'s' * (len(stations) > 1)}"
        return f"the {end}, {count}{where}: {list_first(stations.shown, 4)}"
    if site.static_position is None:
        return f"the {end}, at an unknown place"
    place = site.static_position + site.origin  # local coordinates are centred in float64
    name = "" if stations is None else f" {stations.name[0]},"
    return f"the {end},{name} at ({', '.join(f'{x:.3f}' for x in place)}) m"


def _moving(data: Measurements) -> str:
    ends = {"receiver": data.rx_position, "transmitter": data.tx}
    if data.site.static_end is not None:
        ends = {ENDS[data.site.moving_end]: data.moving}
    return "; ".join(f"the {end},{_box(places)}" for end, places in ends.items())


def _box(places: np.ndarray) -> str:
    return f" in a box of {' x '.join(f'{e:.2f}' for e in np.ptp(places, axis=0))} m"


def suspicious_values(data: Measurements) -> list[str]:
    """Warn of readable but implausible values: millimetres, radians, linear powers given as dB."""
    site, ends = data.site, np.concatenate([data.tx, data.rx_position]) + data.site.origin
    hints = []
    if not np.ptp(data.moving, axis=0).any():
        hints = ["all positions are the same, a box of 0 m: is it the moving end's column?"]
    elif site.georeference is None:  # degrees became metres: no unit to mistake
        # Both ends first; then the moving one alone, as a static end elsewhere widens the box.
        hints = _units(ends[np.isfinite(ends).all(axis=1)]) or _units(data.moving[:, :3] + site.origin)
    if site.array is not None and site.wavelength is not None:
        reach = float(np.ptp(site.array, axis=0).max())
        if reach > LONG_ARRAY * site.wavelength:
            waves = f"{reach / site.wavelength:.3g} wavelengths"
            hints.append(f"the antennas reach over {reach:.4g} m, {waves}: in mm?")
    if site.grid is not None:
        turn = np.degrees(site.grid.azimuth_step * site.grid.width)
        # Steps in radians taken for degrees: the columns then span 2 pi degrees.
        if abs(turn / (2 * np.pi) - 1) < 0.02:
            hints.append(f"the columns span {turn:.3g} degrees, a full circle in radians; convert grid_deg")
    if site.kind == "rssi" and (data.target == 0).any():
        count = int((data.target == 0).sum())
        hints.append(
            f"{count} powers are exactly 0, learned as -300 dB: not heard? make them NaN, or give "
            "rssi_db and sensitivity_db"
        )
    if site.kind == "rssi" and (data.target > 0).all():
        spread = 10 * float(np.log10(data.target.max() / data.target.min()))
        # Linear powers taken for dB are all next to 0 dB: 10^(1e-9 / 10) is 1.
        if 0 < spread < 0.1:
            hints.append(f"the powers differ by {spread:.1g} dB in all; if they are linear, call them rssi")
    return hints


def _units(positions: np.ndarray) -> list[str]:
    """Warnings that positions (n, 3), in the world, may not be metres."""
    extent, middle = np.ptp(positions, axis=0), np.abs(np.median(positions[:, :2], axis=0))
    height, width, across = float(extent[2]), float(extent.max()), float(extent[:2].max())
    reach = np.abs(positions[:, :2]).max(axis=0)
    on_earth = reach.max() <= 180 and reach.min() <= 90
    # Metres about a local origin lie near it; degrees of a small site lie many of its widths away.
    if on_earth and across < TINY_DEGREES and middle.min() > 5 * across and middle.max() > 10:
        near = f"({positions[0, 0]:.6g}, {positions[0, 1]:.6g})"
        how = "then give them as latitude and longitude (columns of a table: dataset.columns.lat=HEAD, .lon)"
        return [f"positions near {near} within {across:.2g}: degrees? {how}"]
    groups = outliers.find_gap(positions[:, :2])
    if groups is not None:
        said = f"two groups of places {groups[1] / 1e3:.4g} km apart"
        return [f"{said}: zones of a projection, or two sites? give degrees, or a file for each"]
    # Heights 100 m apart, or a width of 10 km, are rarer than wrong units.
    if height > 100 or width > 1e4:
        unit, factor = ("millimetres", 1e-3) if height > 1000 or width > 1e4 else ("centimetres", 1e-2)
        size = " x ".join(f"{e * factor:.3g}" for e in extent)
        hint = f"if these are {unit}, the box is {size} m: convert to metres"
        far = f"heights differ by {height:.4g} m" if height > 100 else f"positions reach over {width:.4g} m"
        return [f"{far}; {hint}"]
    # Survey tools print millimetres as whole numbers; metres come with decimals.
    if across > 1000 and (positions % 1 == 0).all():
        size = " x ".join(f"{e / 1000:.4g}" for e in extent)
        said = f"positions are whole numbers up to {across:.0f} apart"
        return [f"{said}: millimetres? the box is {size} m then"]
    if 0 < width < 0.01:
        return [f"everything lies within {width * 1e3:.2g} mm; if these are kilometres, convert to metres"]
    return []


def _grid(grid: SphereGrid) -> str:
    first = np.degrees([grid.first_elevation, grid.first_azimuth])
    step = np.degrees([grid.elevation_step, grid.azimuth_step])
    last = first + step * [grid.height - 1, grid.width - 1]
    closed = ", closing the circle" if grid.periodic else ""
    return (
        f"rows are elevations {first[0]:.4g} to {last[0]:.4g} degrees, "
        f"columns azimuths {first[1]:.4g} to {last[1]:.4g} degrees{closed}"
    )


ROUND = (1.0, 2.0, 3.0, 5.0, 10.0)
APART = 3.0  # least side of a square, in distances of neighbours


def propose_side(data: Measurements) -> float | None:
    """Return a side [m] for `split=blocks`: a tenth of the site, several neighbours wide, round.

    None where the places are too few to hold squares of them out.
    """
    places = data.moving[:, :2]  # as `split=blocks` cuts squares, of both ends too
    extent = float(np.ptp(places, axis=0).max())
    if extent == 0:
        return None
    least = max(extent / 10, APART * neighbour_distance(places))
    decade = 10 ** np.floor(np.log10(least))
    # At 0.99 a least side of 2.01 m still may be 2 m.
    side = next(float(decade * step) for step in ROUND if decade * step >= 0.99 * least)
    return side if side < extent / 2 else None


def held_out_block_rows(data: Measurements, side: float) -> np.ndarray:
    """Return rows that `split=blocks split.side_m=<side>` tests on; none where it cannot be cut so."""
    try:
        split = split_for({"name": "blocks", "side_m": side}, data)
        split.check()
    except ValueError:
        return np.zeros(0, np.int64)
    return split.folds[0].test


def propose_split(data: Measurements) -> str:
    """Propose a split, in one sentence for `gsparc check`."""
    between = "split=random asks about places between these"
    side = propose_side(data)
    if side is None or not len(held_out_block_rows(data, side)):
        return f"{between}; too few places to hold out squares of floor"
    return f"{between}; split=blocks split.side_m={side:g} about holes of {side:g} m"
