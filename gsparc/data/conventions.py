"""Conventions of channels and spectra: what a file may follow instead of the schema's, and what mends it.

`CONVENTIONS` names each with the change from it to the schema's: applied where a setting or an attribute of
the file names it, and tried by `gsparc.data.checks.conventions`, which scores how well the direct path fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from gsparc.data.blocks import blocks, is_big, scratch
from gsparc.data.errors import DataError, nearest
from gsparc.data.schema import LIGHT, Measurements
from gsparc.ops import SphereGrid


@dataclass(frozen=True)
class Signals:
    """Channels (S, A, K) or spectra (S, H, W) and the geometry of their rows.

    Attributes:
        values: complex channels, or real spectra.
        mask: like `values`, bool, True where measured; None where all was.
        tx, rx: (S, 3) [m].
        rotation: (S, 3, 3), receiver to world.
        tones: (K,) [Hz]; None of spectra.
        array: (A, 3) [m], receiver frame; None where unknown.
        grid: of spectra.
    """

    values: np.ndarray
    mask: np.ndarray | None
    tx: np.ndarray
    rx: np.ndarray
    rotation: np.ndarray
    tones: np.ndarray | None = None
    array: np.ndarray | None = None
    grid: SphereGrid | None = None

    @classmethod
    def of(cls, data: Measurements) -> Self:
        """Take the signals of measurements that are no powers."""
        site, tones = data.site, None if data.site.kind == "spectrum" else data.site.tones()
        array = None if site.array is None or len(site.array) != data.target.shape[1] else site.array
        ends = data.tx, data.rx_position, data.rx_rotation
        return cls(data.target, data.mask, *ends, tones, None if tones is None else array, site.grid)

    def moved(self, change: Callable[[np.ndarray], np.ndarray]) -> Signals:
        """Return the same with entries of values and mask elsewhere."""
        mask = None if self.mask is None else change(self.mask)
        return replace(self, values=change(self.values), mask=mask)

    def rows(self, part: slice | np.ndarray) -> Signals:
        """Return some of the rows."""
        of_rows = ("values", "mask", "tx", "rx", "rotation")
        whole = {name: getattr(self, name) for name in of_rows}
        parts: dict[str, Any] = {name: None if one is None else one[part] for name, one in whole.items()}
        return replace(self, **parts)

    @property
    def wavelength(self) -> float:
        """Of the middle of the tones [m]."""
        assert self.tones is not None
        return LIGHT / float(self.tones.mean())


@dataclass(frozen=True)
class Convention:
    """One that a file may follow.

    Attributes:
        words: what it says of them.
        change: to the schema's.
        applies: whether it can be of these.
        tried: whether `check` scores it.
    """

    words: str
    change: Callable[[Signals], Signals]
    applies: Callable[[Signals], bool]
    tried: bool


Change = Callable[[Signals], Signals]


def _values(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda signals: replace(signals, values=change(signals.values))


def _moved(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda signals: signals.moved(change)


def _array(factor: Callable[[Signals], float]) -> Change:
    return lambda signals: replace(signals, array=np.asarray(signals.array) * factor(signals))


def _grid(first: Callable[[SphereGrid], tuple[float, float]], flipped: int = 0) -> Change:
    """The first elevation and azimuth changed, one axis reversed."""

    def turned(signals: Signals) -> Signals:
        assert signals.grid is not None
        elevation, azimuth = first(signals.grid)
        grid = replace(signals.grid, first_elevation=elevation, first_azimuth=azimuth)
        return replace(signals.moved(lambda v: np.flip(v, flipped) if flipped else v), grid=grid)

    return turned


def _with_delays(signals: Signals) -> Signals:
    assert signals.tones is not None
    distance = np.linalg.norm(signals.tx - signals.rx, axis=1)
    # About the mean of the tones, so that phases there stay.
    turns = (signals.tones - signals.tones.mean()) * distance[:, None] / LIGHT
    return replace(signals, values=signals.values * np.exp(-2j * np.pi * turns)[:, None])


def _without_zeros(signals: Signals) -> Signals:
    # A tone that is 0 in all rows and antennas was not measured, like guard tones of OFDM.
    heard = [(signals.values[part] != 0).any(axis=(0, 1)) for part in blocks(signals.values)]
    measured = np.broadcast_to(np.any(heard, axis=0), signals.values.shape)
    return replace(signals, mask=measured if signals.mask is None else measured & signals.mask)


def _transposed(signals: Signals) -> Signals:
    # Only images without `grid_deg` come here (`_hemisphere`): the grid follows from their shape.
    grid = SphereGrid.hemisphere(*signals.values.shape[:0:-1])
    return replace(signals.moved(lambda values: values.swapaxes(1, 2)), grid=grid)


def _last(grid: SphereGrid) -> tuple[float, float]:
    """Elevation and azimuth of the last row and column [rad]."""
    elevation = grid.first_elevation + (grid.height - 1) * grid.elevation_step
    return elevation, grid.first_azimuth + (grid.width - 1) * grid.azimuth_step


def _from_zenith(grid: SphereGrid) -> tuple[float, float]:
    # Angles from the zenith run downwards: rows are reversed, and begin where the last one was.
    return math.pi / 2 - _last(grid)[0], grid.first_azimuth


def _azimuth(turn: float) -> Change:
    return _grid(lambda grid: (grid.first_elevation, grid.first_azimuth + turn))


def _channel(signals: Signals) -> bool:
    return signals.tones is not None


def _sphere(signals: Signals) -> bool:
    return signals.grid is not None


def _above(signals: Signals) -> bool:
    return signals.grid is not None and signals.grid.first_elevation >= 0


def _hemisphere(signals: Signals) -> bool:
    """Of the file, or of its transpose: no `grid_deg` says otherwise."""
    height, width = signals.values.shape[1:]
    return signals.grid in (SphereGrid.hemisphere(height, width), SphereGrid.hemisphere(width, height))


def _tones(signals: Signals) -> bool:
    return signals.tones is not None and signals.values.shape[2] > 1


def _square(signals: Signals) -> bool:
    return signals.tones is not None and 1 < signals.values.shape[1] == signals.values.shape[2]


def _antennas(signals: Signals) -> bool:
    return signals.tones is not None and signals.array is not None


UNTRIED = ("swap_iq", "zeros_unmeasured", "decibels")  # as conjugate, or told by other means
_ROWS: dict[str, tuple[str, Callable[[Signals], Signals], Callable[[Signals], bool]]] = {
    "conjugate": ("conjugated channels, exp(+j 2 pi f d / c)", _values(np.conj), _channel),
    # I and Q exchanged are a conjugate turned by a quarter: Q + jI = j conj(I + jQ).
    "swap_iq": ("I and Q swapped", _values(lambda v: 1j * v.conj()), _channel),
    "exchange_axes": ("axes of antennas and tones exchanged", _moved(lambda v: v.swapaxes(1, 2)), _square),
    "fft_order": ("tones in the order of an FFT", _moved(lambda v: np.fft.fftshift(v, axes=2)), _tones),
    "reverse_tones": ("tones from the highest to the lowest", _moved(lambda v: np.flip(v, 2)), _tones),
    "reverse_antennas": ("antennas in reverse order", _moved(lambda v: np.flip(v, 1)), _antennas),
    "array_mm": ("array_position in millimetres", _array(lambda _: 1e-3), _antennas),
    "array_wavelengths": ("array_position in wavelengths", _array(lambda s: s.wavelength), _antennas),
    "delays_removed": ("the delay of each row taken out", _with_delays, _tones),
    "zeros_unmeasured": ("0 for tones that were not measured", _without_zeros, _tones),
    "transposed": ("rows as azimuths, columns as elevations", _transposed, _hemisphere),
    "zenith": ("elevation from the zenith", _grid(_from_zenith, 1), _above),
    "clockwise": ("clockwise azimuth", _grid(lambda g: (g.first_elevation, -_last(g)[1]), 2), _sphere),
    "azimuth_180": ("azimuth from -180 degrees", _azimuth(-math.pi), _sphere),
    "azimuth_north": ("azimuth from the y axis", _azimuth(math.pi / 2), _sphere),
    "decibels": ("decibels", _values(lambda v: 10 ** (v.astype(np.float64) / 10)), _sphere),
}
CONVENTIONS = {name: Convention(*row, name not in UNTRIED) for name, row in _ROWS.items()}


def mended(signals: Signals, names: Iterable[str]) -> Signals:
    """Return signals in the schema's conventions, from those of a file that follows the ones named.

    Raises:
        DataError: no such convention, or one that cannot be of these measurements.
    """
    chosen = set(names)
    for name in chosen - set(CONVENTIONS):
        hint = nearest(name, CONVENTIONS, 0.4)
        raise DataError(f"conventions: {name!r} is none of {', '.join(CONVENTIONS)}{hint}")
    # In the table's order, not the user's: axes are exchanged before what runs along them is turned.
    for name in [name for name in CONVENTIONS if name in chosen]:
        one = CONVENTIONS[name]
        if not one.applies(signals):
            shape = signals.values.shape[1:]
            raise DataError(f"dataset.{name}: {one.words}: cannot be of rows of shape {shape}")
        # Which tones are 0 is a matter of all rows, and changes no value.
        by_block = is_big(signals.values) and name != "zeros_unmeasured"
        signals = _in_blocks(signals, one.change) if by_block else one.change(signals)
    return signals


def _in_blocks(signals: Signals, change: Callable[[Signals], Signals]) -> Signals:
    """The same block by block, with values on disk."""
    # One row tells the shape, dtype, array and grid that the change leads to.
    first = change(signals.rows(slice(0, 1)))
    values = scratch((len(signals.values), *first.values.shape[1:]), first.values.dtype)
    masks = []
    for part in blocks(signals.values):
        changed = change(signals.rows(part))
        values[part] = changed.values
        masks += [] if changed.mask is None else [changed.mask]
    mask = np.concatenate(masks) if masks else None
    return replace(signals, values=values, mask=mask, array=first.array, grid=first.grid)
