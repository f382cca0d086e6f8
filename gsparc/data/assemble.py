"""From validated world coordinates to `Measurements`: centred in float64, scaled, hashed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np

from gsparc.data.blocks import blocks, contents
from gsparc.data.checks.outliers import peaks, too_far, too_strong
from gsparc.data.errors import Problems
from gsparc.data.schema import Links, Measurements, Site, TrainTest

FARTHEST = 1e7  # [m]; an Earth radius and a half: anything beyond is not a position in metres


def bad_positions(position: np.ndarray) -> np.ndarray:
    """Return rows (n,) of `position` (S, 3) [m] that no place on Earth could have."""
    with np.errstate(invalid="ignore"):
        good = np.isfinite(position).all(axis=-1) & (np.abs(position) <= FARTHEST).all(axis=-1)
    return np.flatnonzero(~good)


def check_positions(problems: Problems, where: str, position: np.ndarray, row_names: list[str]) -> bool:
    """Note rows whose position (S, 3) [m] is not finite or not on Earth; returns whether there are any."""
    bad = bad_positions(position)
    problems.add_rows(
        where,
        (f"{row_names[i]} = {np.array2string(position[i], separator=', ')}" for i in bad),
        f"expected three finite coordinates in metres, none beyond {FARTHEST:.0e}",
    )
    return len(bad) > 0


def rounded_rms(values: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the root mean square of rows `values` (S, ...), real or complex, in whole dB; 0 if all are zero.

    This is a constant of the site, taken over all rows but those that are `too_strong` for the others:
    rounding keeps any single row (which may be a test row) from influencing it. `weight` is a bool mask of
    measured entries.
    """
    highest = peaks(values, weight)
    usual = ~too_strong(highest)
    peak = float(highest[usual].max(initial=0.0))
    if peak == 0.0:
        return 0.0
    total, count = 0.0, 0
    for part in blocks(values):
        rows = values[part][usual[part]]
        # Relative to the peak, so that squares of 1e-200 or 1e200 neither vanish nor overflow.
        rows = rows if weight is None else rows[weight[part][usual[part]]]
        magnitude = np.abs(rows).astype(np.float64) / peak
        total, count = total + float((magnitude**2).sum()), count + magnitude.size
    return float(10 ** (round(20 * np.log10(peak * np.sqrt(total / count))) / 20))


def content_hash(arrays: Mapping[str, np.ndarray | None]) -> str:
    """Return the SHA-256 of named arrays (type, shape, bytes), the same whatever file they came from."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        if array is None:
            continue
        array = np.ascontiguousarray(array)  # of one number too: (1,)
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        for part in contents(array):
            digest.update(part)
    return digest.hexdigest()


def identity(data: Measurements) -> str:
    """Return the SHA-256 of all that a method learns from, for the names of kept results.

    The content hash of a site (`Site.sha256`) is of the measurements alone: on another grid, in another unit
    or about another origin they are other data.
    """
    directions = {f"directions {row}": one for row, one in enumerate(data.directions or ())}
    auxiliary = content_hash({**directions, "uplink": data.uplink})
    return hashlib.sha256(f"{_fact_text(data.site)} {auxiliary}".encode()).hexdigest()


def _fact_text(fact: Any) -> str:
    """A fact of a site as text: the same before and after a checkpoint."""
    if isinstance(fact, np.ndarray):
        return content_hash({"": fact})
    if is_dataclass(fact):
        return str({one.name: _fact_text(getattr(fact, one.name)) for one in fields(fact)})
    return repr(fact.item() if isinstance(fact, np.generic) else fact)


def assemble(
    *,
    static_end: Literal["rx", "tx"] | None,
    tx: np.ndarray,
    rx: np.ndarray,
    rx_rotation: np.ndarray,
    target: np.ndarray,
    target_scale: float = 1.0,
    mask: np.ndarray | None = None,
    noise_variance: np.ndarray | None = None,
    directions: list[np.ndarray] | None = None,
    row_names: list[str] | None = None,
    release_split: TrainTest | None = None,
    provenance: Mapping[str, str] | None = None,
    array: np.ndarray | None = None,
    carrier_hz: float | None = None,
    subcarriers_hz: np.ndarray | None = None,
    links: Links | None = None,
    position_std: np.ndarray | None = None,
    **facts: Any,
) -> Measurements:
    """Centre measurements on the scene box, from validated world coordinates.

    Args:
        static_end, array, carrier_hz, subcarriers_hz, **facts: see `Site`.
        tx, rx: (S, 3) [m], world coordinates, float64.
        rx_rotation: (S, 3, 3), local to world.
        target: (S, ...) already divided by `target_scale`.
        target_scale: stored target = physical target / target_scale.
        noise_variance: (S,) in units of the stored target.
        release_split: (train, test) rows that the data themselves name.
        mask, directions, row_names, provenance, position_std: see `Measurements`.
        links: of several stations, censored or unknown ends; None where there is nothing to say.
    """
    links = links or Links(static_end)
    stations = links.stations
    # A place far outside would put the middle there, where float32 has lost centimetres.
    usual = ~too_far(tx if static_end == "rx" else rx)
    ends = np.concatenate([tx[usual], rx[usual]])
    ends = ends[np.isfinite(ends).all(axis=1)]  # without what stands at an unknown place
    lower, upper = ends.min(axis=0), ends.max(axis=0)
    origin = (lower + upper) / 2
    places = {"rx": tx - origin, "tx": rx - origin}
    moving = np.hstack([tx - origin, rx - origin]) if static_end is None else places[static_end]
    hashed = {
        "tx": tx, "rx": rx, "rx_rotation": rx_rotation, "target": target, "mask": mask, "array": array,
        "target_scale": np.array(target_scale), "subcarriers_hz": subcarriers_hz,
        "carrier_hz": None if carrier_hz is None else np.array(carrier_hz), "noise_variance": noise_variance,
        "station": links.station, "place": links.place, "censored": links.censored, "run": links.run,
        "carriers_hz": None if stations is None else stations.carrier_hz, "position_std": position_std,
    }  # fmt: skip
    still = None
    if static_end is not None and (stations is None or len(stations) == 1):
        still = (rx if static_end == "rx" else tx)[0] - origin
        still = still if np.isfinite(still).all() else None
    site = Site(
        static_end=static_end, array=array, carrier_hz=carrier_hz, subcarriers_hz=subcarriers_hz,
        origin=origin, box=np.stack([lower - origin, upper - origin]), sha256=content_hash(hashed),
        target_scale=target_scale, static_position=still, georeference=links.georeference,
        moving_box=np.stack([moving[usual].min(axis=0), moving[usual].max(axis=0)]),
        stations=None if stations is None else replace(stations, position=stations.position - origin),
        rx_rotation=np.array(rx_rotation[0], dtype=np.float64), **facts,
    )  # fmt: skip
    names = row_names or [f"row {i}" for i in range(len(target))]
    return Measurements(
        site, tx - origin, rx - origin, rx_rotation, target, mask, noise_variance, directions, names,
        release_split, dict(provenance or {}), station=links.station, place=links.place,
        censored=links.censored, run=links.run, position_std=position_std,
    )  # fmt: skip
