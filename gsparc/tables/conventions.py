"""Conventions of channels, spectra and places: what a file may follow instead of the schema's.

`CONVENTIONS` names each with the change from it to the schema's: applied where a setting or an
attribute of the file names it, and tried by `gsparc.tables.checks.conventions`,
which scores how well the direct path fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsparc.base.errors import DataError
from gsparc.base.limits import choice
from gsparc.data.blocks import allocate_on_disk, is_big, row_blocks
from gsparc.data.schema import LIGHT, OTHER, End, Measurements
from gsparc.data.units import UNITS
from gsparc.ops import SphereGrid
from gsparc.physics.decibels import from_decibels

FOOT = UNITS["ft"].factor
KILOMETRES = np.array([1e3, 1e3, 1.0])  # heights beside them are in metres
Change = Callable[[Measurements], Measurements]


@dataclass(frozen=True)
class Convention:
    """One that a file may follow.

    Attributes:
        words: what it says of them.
        trait: that measurements need, one of `traits`.
        change: to the schema's.
        tried: whether `check` scores it.
    """

    words: str
    trait: str
    change: Change
    tried: bool = True


def known_array(data: Measurements) -> np.ndarray | None:
    """Return places (A, 3) [m] of the channel's antennas, receiver frame;
    None where they are unknown.
    """
    array = data.site.array if data.site.target.is_complex else None
    return array if array is not None and len(array) == data.target.shape[1] else None


def traits(data: Measurements) -> set[str]:
    """Return what measurements are, as far as conventions ask for it."""
    grid, shape = data.site.grid, data.target.shape[1:]
    # Degrees are no feet; heights beside them may be.
    metres = data.site.georeference is None and not data.site.target.is_image
    placed = {
        "metres": metres,
        "heights": not data.site.target.is_image and bool(np.ptp(data.moving[:, 2])),
    }
    holds = {}
    if data.site.target.is_complex:
        tones, square, antennas = (
            shape[1] > 1,
            1 < shape[0] == shape[1],
            known_array(data) is not None,
        )
        holds = {"channels": True, "tones": tones, "square": square, "antennas": antennas}
    if grid is not None:
        # Of the file, or of its transpose: no `grid_deg` says otherwise.
        plain = grid in (SphereGrid.hemisphere(*shape), SphereGrid.hemisphere(*shape[::-1]))
        holds = {"spectra": True, "above": grid.first_elevation >= 0, "hemisphere": plain}
    turned = {
        "turned": not data.site.target.is_level and bool((data.rx_rotation != np.eye(3)).any())
    }
    return {name for name, flag in {**holds, **placed, **turned}.items() if flag}


def _values(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda data: replace(data, target=change(data.target))


def _moved(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Entries of values and mask are elsewhere."""
    return lambda d: replace(
        d, target=change(d.target), mask=None if d.mask is None else change(d.mask)
    )


def _array(factor: Callable[[Measurements], float]) -> Change:
    return lambda d: replace(d, site=replace(d.site, array=np.asarray(d.site.array) * factor(d)))


def _places(change: Callable[[np.ndarray], np.ndarray], *which: str) -> Change:
    """Positions of ends, `tx`, `rx`, `static` or `moving`, changed about the origin of the file."""

    def moved(data: Measurements) -> Measurements:
        origin, stations, still = data.site.origin, data.site.stations, data.site.still_end
        called: dict[str, End] = {"tx": "tx", "rx": "rx", "static": still, "moving": OTHER[still]}
        ends = {called[end] for end in which}
        if stations is not None and still in ends:
            there = replace(stations, position=change(stations.position + origin) - origin)
            data = replace(data, site=replace(data.site, stations=there))
        return data.with_ends({end: change(data.ends[end] + origin) - origin for end in ends})

    return moved


def _turned(change: Callable[[Rotation], Rotation]) -> Change:
    """Receivers turned otherwise."""
    return lambda d: replace(d, rx_rotation=change(Rotation.from_matrix(d.rx_rotation)).as_matrix())


def _grid(first: Callable[[SphereGrid], tuple[float, float]], flipped: int = 0) -> Change:
    """The first elevation and azimuth changed, one axis reversed."""

    def turned(data: Measurements) -> Measurements:
        assert data.site.grid is not None
        elevation, azimuth = first(data.site.grid)
        grid = replace(data.site.grid, first_elevation=elevation, first_azimuth=azimuth)
        return _moved(lambda v: np.flip(v, flipped) if flipped else v)(_on(data, grid))

    return turned


def _on(data: Measurements, grid: SphereGrid) -> Measurements:
    return replace(data, site=replace(data.site, grid=grid))


def _with_delays(data: Measurements) -> Measurements:
    tones = data.site.tones()
    distance = np.linalg.norm(data.tx - data.rx_position, axis=1)
    # About the mean of the tones, so that phases there stay.
    turns = (tones - tones.mean()) * distance[:, None] / LIGHT
    return replace(data, target=data.target * np.exp(-2j * np.pi * turns)[:, None])


def _transposed(data: Measurements) -> Measurements:
    # Only images without `grid_deg` come here (`hemisphere`): the grid follows from their shape.
    grid = SphereGrid.hemisphere(*data.target.shape[:0:-1])
    return _moved(lambda values: values.swapaxes(1, 2))(_on(data, grid))


def _last(grid: SphereGrid) -> tuple[float, float]:
    """Elevation and azimuth of the last row and column [rad]."""
    elevation = grid.first_elevation + (grid.height - 1) * grid.elevation_step
    return elevation, grid.first_azimuth + (grid.width - 1) * grid.azimuth_step


def _from_zenith(grid: SphereGrid) -> tuple[float, float]:
    # Angles from the zenith run downwards: rows are reversed, and begin where the last one was.
    return math.pi / 2 - _last(grid)[0], grid.first_azimuth


def _azimuth(turn: float) -> Change:
    return _grid(lambda grid: (grid.first_elevation, grid.first_azimuth + turn))


CONVENTIONS = {
    "conjugate": Convention(
        "conjugated channels, exp(+j 2 pi f d / c)", "channels", _values(np.conj)
    ),
    # I and Q exchanged are a conjugate turned by a quarter, Q + jI = j conj(I + jQ): tried as such.
    "swap_iq": Convention("I and Q swapped", "channels", _values(lambda v: 1j * v.conj()), False),
    "exchange_axes": Convention(
        "axes of antennas and tones exchanged", "square", _moved(lambda v: v.swapaxes(1, 2))
    ),
    "fft_order": Convention(
        "tones in the order of an FFT", "tones", _moved(lambda v: np.fft.fftshift(v, axes=2))
    ),
    "reverse_tones": Convention(
        "tones from the highest to the lowest", "tones", _moved(lambda v: np.flip(v, 2))
    ),
    "reverse_antennas": Convention(
        "antennas in reverse order", "antennas", _moved(lambda v: np.flip(v, 1))
    ),
    "array_mm": Convention("array_position in millimetres", "antennas", _array(lambda _: 1e-3)),
    "array_wavelengths": Convention(
        "array_position in wavelengths",
        "antennas",
        _array(lambda data: LIGHT / float(data.site.tones().mean())),
    ),
    "delays_removed": Convention("the delay of each row taken out", "tones", _with_delays),
    "feet": Convention("positions in feet", "metres", _places(lambda p: p * FOOT, "tx", "rx")),
    "centimetres": Convention(
        "positions in centimetres", "metres", _places(lambda p: p / 100, "tx", "rx")
    ),
    "static_feet": Convention(
        "places of stations in feet beside rows in metres",
        "metres",
        _places(lambda p: p * FOOT, "static"),
    ),
    "moving_feet": Convention(
        "places of rows in feet beside stations in metres",
        "metres",
        _places(lambda p: p * FOOT, "moving"),
    ),
    "static_kilometres": Convention(
        "places of stations in kilometres beside rows in metres",
        "metres",
        _places(lambda p: p * KILOMETRES, "static"),
    ),
    "moving_kilometres": Convention(
        "places of rows in kilometres beside stations in metres",
        "metres",
        _places(lambda p: p * KILOMETRES, "moving"),
    ),
    "heights_feet": Convention(
        "heights of rows in feet", "heights", _places(lambda p: p * [1, 1, FOOT], "moving")
    ),
    "exchange_xy": Convention(
        "x and y of the receiver exchanged", "metres", _places(lambda p: p[:, [1, 0, 2]], "rx")
    ),
    "downwards": Convention(
        "heights of the receiver counted downwards",
        "metres",
        _places(lambda p: p * [1, 1, -1], "rx"),
    ),
    "scalar_last": Convention(
        "orientations as x, y, z, w",
        "turned",
        _turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), 1, 1))),
    ),
    "world_to_receiver": Convention(
        "orientations from the world to the receiver", "turned", _turned(lambda r: r.inv())
    ),
    "transposed": Convention("rows as azimuths, columns as elevations", "hemisphere", _transposed),
    "zenith": Convention("elevation from the zenith", "above", _grid(_from_zenith, 1)),
    "clockwise": Convention(
        "clockwise azimuth", "spectra", _grid(lambda g: (g.first_elevation, -_last(g)[1]), 2)
    ),
    "azimuth_180": Convention("azimuth from -180 degrees", "spectra", _azimuth(-math.pi)),
    "azimuth_north": Convention("azimuth from the y axis", "spectra", _azimuth(math.pi / 2)),
    "decibels": Convention(
        "decibels", "spectra", _values(lambda v: from_decibels(v.astype(np.float64))), False
    ),
}


def convert_conventions(data: Measurements, names: Iterable[str]) -> Measurements:
    """Return measurements in the schema's conventions,
    from those of a file that follows the ones named.

    Raises:
        DataError: no such convention, or one that cannot be of these measurements.
    """
    chosen = set(names)
    for name in chosen:
        choice(*CONVENTIONS).check("conventions", name)
    # In the table's order, not the user's: axes are exchanged before what runs along them is
    # turned.
    for name in [name for name in CONVENTIONS if name in chosen]:
        convention = CONVENTIONS[name]
        if convention.trait not in traits(data):
            shape = data.target.shape[1:]
            raise DataError(
                f"dataset.{name}: {convention.words}: cannot be of rows of shape {shape}"
            )
        data = (
            _in_blocks(data, convention.change) if is_big(data.target) else convention.change(data)
        )
    return data


def _in_blocks(data: Measurements, change: Change) -> Measurements:
    """The same block by block, with values on disk."""
    rows = np.arange(len(data))
    # One row tells the shape, dtype, array and grid that the change leads to.
    first = change(data.subset(rows[:1]))
    values, masks = allocate_on_disk((len(data), *first.target.shape[1:]), first.target.dtype), []
    for part in row_blocks(data.target):
        changed = change(data.subset(rows[part]))
        values[part] = changed.target
        masks += [] if changed.mask is None else [changed.mask]
    return replace(
        data, target=values, mask=np.concatenate(masks) if masks else None, site=first.site
    )
