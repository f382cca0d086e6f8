"""Rows that come later, checked as the first rows are,
and against the model that is told of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gsparc.base.errors import DataError, name_row_ranges
from gsparc.data.assemble import content_hash
from gsparc.data.ends import stations_at
from gsparc.data.outliers import are_kilometres, far_from_box
from gsparc.data.schema import Measurements, Site
from gsparc.data.units import PowerUnit
from gsparc.models.device_offsets import subtract_known_device_offsets
from gsparc.ops.transforms import to_numpy
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.query import read_places
from gsparc.processes.powers import PowerRows
from gsparc.tables.arrays import Raw, name_rows_by_number
from gsparc.tables.links.strongest import strongest_lists
from gsparc.tables.own_checks import Checker

ABOVE_DB = 120.0  # over the mean power of a site: more than receivers' levels span


@dataclass(frozen=True)
class LevelRows(PowerRows):
    """Levels of stored powers that were measured, as they came,
    at local places of the end that moves.

    Attributes:
        station: (n,) int64; of one that the model does not know any other number.
        name: (n,) text, what messages call each.
        still: (n, 3) local places of the stations [m].
    """

    station: np.ndarray
    name: np.ndarray
    still: np.ndarray

    def __len__(self) -> int:
        return len(self.station)

    def content(self) -> str:
        """Return the SHA-256 of places, levels and stations, in their order."""
        told = {name: part for name, part in vars(self).items() if name not in ("name", "still")}
        return content_hash(told)


def check_updatable(site: Site) -> None:
    """Raise `ValueError` where a site's models learn no later rows: not powers,
    or both ends move.
    """
    if not site.maps_levels:
        targets = site.target.called + (" of two moving ends" if site.target.is_level else "")
        other = "hear() takes channels" if site.target.is_complex else "train again on all rows"
        raise ValueError(f"update: models of {targets} cannot be updated: {other}")


def read_level_rows(data: Measurements, site: Site) -> LevelRows:
    """Return measurements of powers, in a model's coordinates, as `update` takes them,
    in their order.

    Raises:
        ValueError: lists of the strongest, or what no row of this model can be.
    """
    if strongest_lists(data) is not None:
        raise ValueError(
            "update: lists of the strongest hold what is strong, and would raise all levels; "
            "train on all "
            "drives, gsparc evaluate names cells that are gone"
        )
    data = subtract_known_device_offsets(data, site)
    rows = (
        np.arange(len(data)) if data.sequence is None else np.argsort(data.sequence, kind="stable")
    )
    if data.mask is not None:
        rows = rows[data.mask[rows].reshape(len(rows)) | (data.censored_side(rows) != 0)]
    level = data.site.target.to_real(data.target[rows])[:, 0].astype(np.float64)
    station, name = data.stations_of(rows), np.array(data.row_names)[rows]
    still = data.site.every_station.position[station]
    return _checked(
        LevelRows(data.moving[rows], level, data.censored_side(rows), station, name, still), site
    )


def read_level_arrays(
    site: Site, places: Any, levels: Any, unit: PowerUnit, still: Any = None
) -> tuple[LevelRows, int]:
    """Return rows of arrays, NaN of which is not measured, and how many were not heard at all.

    Args:
        site: of the model.
        places: (n, 3) or (3,) of the end that moves, world [m].
        levels: (n,) of one station, or (n, T), in `unit`; of one place (T,), too.
        unit: of `levels`.
        still: (n, 3) or (3,) of the other end, of which `levels` are then alone; None: of stations.

    Raises:
        DataError: not such arrays, or what no row of this model can be; rows are numbered from 0.
    """
    name, position = "rssi_db" if unit.decibels else "rssi", f"{site.moving_end}_position"
    if places is None or levels is None:
        raise DataError(f"update: {site.moving_end}= and rssi= are needed")
    arrays = {position: _numbers(position, places), name: _numbers(name, levels)}
    known = site.every_station.position
    check, count = Checker(Raw(arrays), "update"), len(known) if still is None else 1
    at = check.read_positions(position, None)
    values = None
    if at is not None:
        if at.ndim == 1 and arrays[name].ndim < 2:
            arrays[name] = arrays[name].reshape(1, -1)
        at = np.atleast_2d(at)
        check.row_names = name_rows_by_number(len(at)).tolist()
        values = check.read_real(name, (len(at), count), *[(len(at),)] * (count == 1))
    if at is not None and values is not None:
        values = values.reshape(len(at), count)
        silent = values == (-np.inf if unit.decibels else 0)
        check.check_range(name, values, ~np.isnan(values) & ~silent)
        if np.isnan(values).all():
            check.refuse(name, "nothing was measured; expected numbers")
    if at is None or values is None or check.problems:
        first, *others = dict.fromkeys(check.problems)
        raise DataError(f"{first} (and {len(others)} more)" if others else first)
    row, station = np.nonzero(~np.isnan(values) & ~silent)
    level = to_decibels(unit.stored(torch.from_numpy(values)).numpy()[row, station])
    names, here = np.array(check.row_names)[row], known[station]
    if still is not None:
        here = np.broadcast_to(read_places("update, the other end", still), at.shape)[row]
        here = here - site.origin
        station = stations_at(torch.from_numpy(known), torch.from_numpy(here)).numpy()
    heard = np.zeros(len(row), np.int8)
    result = LevelRows(at[row] - site.origin, level, heard, station, names, here)
    return _checked(result, site), int(silent.sum())


def _numbers(name: str, value: Any) -> np.ndarray:
    """An array as it was given; None is NaN. `DataError` where rows have different lengths,
    or hold text.
    """
    try:
        array = to_numpy(value) if isinstance(value, torch.Tensor) else np.asarray(value)
        array = array.astype(np.float64) if array.dtype == object else array
    except (TypeError, ValueError):
        lengths = [np.size(part) for part in value] if isinstance(value, list | tuple) else []
        usual = max(lengths, key=lengths.count, default=0)
        odd = next((i for i, length in enumerate(lengths) if length != usual), None)
        fault = (
            "expected numbers" if odd is None else (f"holds {lengths[odd]} numbers, others {usual}")
        )
        raise DataError(f"update, {name}{'' if odd is None else f', row {odd}'}: {fault}") from None
    if not array.size:
        raise DataError(
            f"update, {name}: shape {array.shape} holds nothing; expected a row or more"
        )
    return array


def _checked(rows: LevelRows, site: Site) -> LevelRows:
    """The rows; `DataError` names those that lie where, or hold what, no row of this model can."""
    box, world = site.moving_box[:, :3] + site.origin, rows.places + site.origin

    def refuse(bad: np.ndarray, say: Callable[[int], str]) -> None:
        numbers = np.flatnonzero(bad)
        if len(numbers):
            names = name_row_ranges([str(name) for name in rows.name[numbers]])
            raise DataError(f"update, {names}: {say(int(numbers[0]))}")

    kilometres = len(rows) > 0 and are_kilometres(world, box)
    inside = (
        "and all others lie within the site when they are multiplied by 1000: in "
        "kilometres? give metres"
    )
    refuse(np.full(len(rows), kilometres), lambda i: f"{world[i].round(6).tolist()} {inside}")
    away, width = np.linalg.norm(world - box.mean(0), axis=1) / 1e3, np.ptp(box, axis=0).max()
    reach = f"km from the middle of the model's rows, which reach over {width:.4g} m"
    system = "are both in one system and unit? else take them out"
    refuse(far_from_box(world, box), lambda i: f"{away[i]:.4g} {reach}; {system}")
    over = rows.decibels  # stored powers have a mean of about 1
    above = "dB above the mean power of the model's rows; is its sign lost, or its unit another?"
    refuse(over > ABOVE_DB, lambda i: f"a level {over[i]:.4g} {above}")
    return rows
