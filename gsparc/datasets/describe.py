"""Sentences about measurements."""

from __future__ import annotations

import numpy as np

from gsparc.base.errors import list_first
from gsparc.data.schema import ENDS, LIGHT, Measurements, Site
from gsparc.data.spacing import neighbour_distance
from gsparc.data.splits import Split
from gsparc.datasets.load import split_for
from gsparc.ops import SphereGrid
from gsparc.tables.checks.coherence import estimate_coherence


def describe(data: Measurements) -> list[tuple[str, str]]:
    """Return (topic, sentence) pairs about a dataset;
    topics of what it has none of are left out.
    """
    site, pair, error = data.site, data.release_split, data.site.convergence_error
    phases = estimate_coherence(data)
    tones = np.zeros(1) if site.subcarriers_hz is None else site.subcarriers_hz
    weak, strong = (int((data.censored_side() == side).sum()) for side in (1, -1))
    # Wavelengths and stored scales tell who reads powers nothing.
    paths, scale, powers = data.directions, site.target_scale, site.target.is_level
    lines = [
        (
            "name",
            site.name + (f" (SIMULATED, stands in for {site.stand_in})" if site.stand_in else ""),
        ),
        ("kind", f"{site.kind}: {_targets(data)}"),
        ("stays", _static(site)),
        ("moves", _moving(data)),
        ("neighbours", spacing_words(distinct_places(data), None if powers else site.carriers)),
        ("carrier", _carrier(site)),
        (
            "band",
            f"{len(tones)} subcarriers over {np.ptp(tones) / 1e6:.6g} MHz"
            if len(tones) > 1
            else "",
        ),
        ("grid", "" if site.grid is None else _grid(site.grid)),
        ("array", "" if site.array is None else f"{len(site.array)} receive antennas"),
        (
            "scale",
            "" if powers or scale == 1 else f"measurements are divided by {scale:.4g}, then stored",
        ),
        (
            "censored",
            f"{weak} of {len(data)} powers lie below a level (unheard, unlisted), "
            f"{strong} above one"
            if data.censored is not None
            else "",
        ),
        (
            "runs",
            ""
            if data.run is None
            else f"{data.run.max() + 1}{'' if powers else ', of unknown factors'}",
        ),
        ("phases", "" if phases is None else str(phases)),
        (
            "mask",
            f"{data.mask.mean():.1%} of the entries were measured"
            if data.mask is not None and data.censored is None
            else "",
        ),
        ("directions", "" if paths is None else f"{sum(map(len, paths))} directions of arrival"),
        (
            "split",
            ""
            if pair is None
            else f"its own: {len(pair[0])} rows to train, {len(pair[1])} to test",
        ),
        ("split?", propose_split(data)),
        (
            "convergence",
            "" if error is None else f"solver error (NMSE between two seeds) {error:.3g}",
        ),
        ("sha256", site.sha256),
    ]
    return [(topic, sentence) for topic, sentence in lines if sentence]


def summarise(data: Measurements, split: Split) -> list[tuple[str, str]]:
    """Return (topic, sentence) pairs about a dataset and how a run divides it."""
    count = len(split.folds)
    whole = [
        sum(len(getattr(fold, part)) for fold in split.folds) for part in ("train", "val", "test")
    ]
    train, val, test = (round(rows / count) for rows in whole)
    folds = f"each of {count} folds has about " if count > 1 else ""
    rows = f"{folds}{train} training, {val} validation and {test} test rows"
    if split.name == "none":
        rows = (
            f"all {train + val} rows are learned from ({val} of them also decide between choices "
            "of a method)"
        )
    lines = [
        ("data", f"{data.site.name}, {data.site.kind}: {_targets(data)}"),
        ("stays", _static(data.site)),
        ("moves", _moving(data)),
        ("carrier", _carrier(data.site)),
        ("split", f"{split.title}: {rows}"),
    ]
    return [(topic, sentence) for topic, sentence in lines if sentence]


def _carrier(site: Site) -> str:
    if np.isnan(site.carriers).any():
        unknown = "unknown; give frequency_hz, and effects that need the phase become available"
        return "" if site.target.is_level else unknown  # of powers the phase is unknown in any case
    carriers = [f"{hertz / 1e9:.6g}" for hertz in np.unique(site.carriers)]
    if len(carriers) > 1:
        return f"{list_first(carriers)} GHz, one for each station"
    return f"{carriers[0]} GHz, wavelength {LIGHT / site.carriers[0]:.4g} m"


def distinct_places(data: Measurements) -> np.ndarray:
    """Return places (n, 3) or (n, 6) [m], one of each visit."""
    return (
        data.moving
        if data.place is None
        else data.moving[np.unique(data.place, return_index=True)[1]]
    )


def _targets(data: Measurements) -> str:
    return data.site.target.describe(len(data), data.target.shape[1:])


def spacing_words(positions: np.ndarray, carriers: np.ndarray | None) -> str:
    """Say how far places (n, 3) [m] are from the nearest other,
    and in wavelengths of the lowest carrier.
    """
    different, counts = np.unique(positions, axis=0, return_counts=True)
    if len(different) < 2:
        return "one place alone"
    distance, same = neighbour_distance(different), int(counts[counts > 1].sum())
    text = f"the nearest other place is {distance:.3g} m away (median)"
    if carriers is not None and np.isfinite(carriers).all():
        lowest = float(carriers.min())
        text += f", {distance * lowest / LIGHT:.2g} wavelengths"
        text += f" of the lowest carrier, {lowest / 1e9:.6g} GHz" if np.ptp(carriers) else ""
    return text + (f"; {same} rows share their place with another" if same else "")


def _static(site: Site) -> str:
    """Which end stands still, and where in the world."""
    if site.paired:
        return "neither end"
    end, stations = ENDS[site.still_end], site.every_station
    if site.stations is not None and (site.several or site.static_position is None):
        places = stations.position[np.isfinite(stations.position).all(axis=1)]
        unknown_count = len(stations) - len(places)
        where = _box(places) if len(places) else ""
        where += f", {unknown_count} of them at unknown places" if unknown_count else ""
        count = f"{len(stations)} station{'s' * (len(stations) > 1)}"
        return f"the {end}, {count}{where}: {list_first(stations.shown, 4)}"
    if site.static_position is None:
        return f"the {end}, at an unknown place"
    place = site.static_position + site.origin  # local coordinates are centred in float64
    name = "".join(f" {shown}," for shown in stations.shown if shown)
    return f"the {end},{name} at ({', '.join(f'{x:.3f}' for x in place)}) m"


def _moving(data: Measurements) -> str:
    moving = sorted(data.site.moving_ends)  # the receiver first
    return "; ".join(f"the {ENDS[end]},{_box(data.ends[end])}" for end in moving)


def _box(places: np.ndarray) -> str:
    return f" in a box of {' x '.join(f'{e:.2f}' for e in np.ptp(places, axis=0))} m"


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
    """Return rows that `split=blocks split.side_m=<side>` tests on;
    none where it cannot be cut so.
    """
    try:
        split = split_for({"name": "blocks", "side_m": side}, data)
        split.check()
    except ValueError:
        return np.zeros(0, np.int64)
    return split.folds[0].test


def propose_split(data: Measurements) -> str:
    """Propose a split, in one sentence for `gsparc check`."""
    between = "split=random tests at places between these"
    side = propose_side(data)
    if side is None or not len(held_out_block_rows(data, side)):
        return f"{between}; too few places to hold out squares of floor"
    return f"{between}; split=blocks split.side_m={side:g} in gaps of {side:g} m"
