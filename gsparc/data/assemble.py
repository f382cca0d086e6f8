"""From validated world coordinates to `Measurements`: centred in float64, scaled, hashed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from gsparc.base.errors import Problems
from gsparc.data.blocks import iterate_bytes
from gsparc.data.outliers import too_far
from gsparc.data.schema import Measurements

FARTHEST = 1e7  # [m]; an Earth radius and a half: anything beyond is not a position in metres


def check_positions(
    problems: Problems, where: str, position: np.ndarray, row_names: list[str]
) -> bool:
    """Note rows whose position (S, 3) [m] is not finite or not on Earth;
    returns whether there are any.
    """
    with np.errstate(invalid="ignore"):
        good = np.isfinite(position).all(axis=-1) & (np.abs(position) <= FARTHEST).all(axis=-1)
    expected = f"expected three finite coordinates in metres, none beyond {FARTHEST:.0e}"
    return problems.add_values(where, row_names, position, good, expected)


def content_hash(arrays: Mapping[str, np.ndarray | float | None]) -> str:
    """Return the SHA-256 of named arrays (type, shape, bytes),
    the same whatever file they came from.
    """
    digest = hashlib.sha256()
    for name in sorted(arrays):
        if arrays[name] is None:
            continue
        array = np.ascontiguousarray(arrays[name])  # of one number too: (1,)
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        for part in iterate_bytes(array):
            digest.update(part)
    return digest.hexdigest()


def identity_hash(data: Measurements) -> str:
    """Return the SHA-256 of all that a method learns from, for the names of kept results.

    The content hash of a site (`Site.sha256`) is of the measurements alone: on another grid, in
    another unit or about another origin they are other data.
    """
    return hashlib.sha256(f"{_fact_text(data.site)} {auxiliary_hash(data)}".encode()).hexdigest()


def auxiliary_hash(data: Measurements) -> str:
    """Return the SHA-256 of directions and uplinks, which that of a site leaves out."""
    directions = {
        f"directions {row}": direction for row, direction in enumerate(data.directions or ())
    }
    return content_hash({**directions, "uplink": data.uplink})


def _fact_text(fact: Any) -> str:
    """A fact of a site as text: the same before and after a checkpoint."""
    if isinstance(fact, np.ndarray):
        return content_hash({"": fact})
    if is_dataclass(fact):
        return str(
            {
                setting_field.name: _fact_text(getattr(fact, setting_field.name))
                for setting_field in fields(fact)
                if setting_field.compare
            }
        )
    return repr(fact.item() if isinstance(fact, np.generic) else fact)


def centre_and_hash(data: Measurements) -> Measurements:
    """Return measurements in world coordinates about the middle of their box, with their hash.

    Args:
        data: ends and stations in float64, validated, targets divided by `site.target_scale`; of
            the site `origin`, the boxes, `sha256`, `static_position`
            and `rx_rotation` are set here.
    """
    site, tx, rx = data.site, data.tx, data.rx_position
    stations, static = site.every_station, site.static_end
    # A place far outside would put the middle there, where float32 has lost centimetres.
    usual = ~too_far(tx if static == "rx" else rx)
    ends = np.concatenate([tx[usual], rx[usual]])
    ends = ends[np.isfinite(ends).all(axis=1)]  # without what stands at an unknown place
    origin = (ends.min(axis=0) + ends.max(axis=0)) / 2
    moved = replace(data, tx=tx - origin, rx_position=rx - origin)
    moving = moved.moving[usual]
    of_rows = (
        "tx",
        "rx_rotation",
        "target",
        "mask",
        "noise_variance",
        "station",
        "place",
        "censored",
        "run",
        "position_std",
        "device",
    )
    hashed = {name: getattr(data, name) for name in of_rows} | {
        "rx": rx,
        "array": site.array,
        "subcarriers_hz": site.subcarriers_hz,
        "target_scale": site.target_scale,
        "carrier_hz": site.carrier_hz,
        "carriers_hz": stations.carrier_hz,
        "arrays": stations.array,
    }
    still = None
    if static is not None and not site.several:
        still = (rx if static == "rx" else tx)[0] - origin
        still = still if np.isfinite(still).all() else None
    site = replace(
        site,
        origin=origin,
        box=np.stack([ends.min(axis=0) - origin, ends.max(axis=0) - origin]),
        moving_box=np.stack([moving.min(axis=0), moving.max(axis=0)]),
        sha256=content_hash(hashed),
        static_position=still,
        rx_rotation=np.array(data.rx_rotation[0], dtype=np.float64),
        stations=site.stations and replace(stations, position=stations.position - origin),
    )
    return replace(moved, site=site)
