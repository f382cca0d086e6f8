"""Conventions of channels and spectra: what a file may follow instead of the schema's, and what mends it.

`CONVENTIONS` names each with the change from it to the schema's: applied where a setting or an attribute of
the file names it, and tried by `gsparc.data.checks.conventions`, which scores how well the direct path fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Self

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
        """Those of measurements that are no powers."""
        site, tones = data.site, None if data.site.kind == "spectrum" else data.site.tones()
        array = None if site.array is None or len(site.array) != data.target.shape[1] else site.array
        ends = data.tx, data.rx_position, data.rx_rotation
        return cls(data.target, data.mask, *ends, tones, None if tones is None else array, site.grid)

    @property
    def kind(self) -> str:
        """Of the measurements."""
        return "spectrum" if self.tones is None else "csi"

    def moved(self, change: Callable[[np.ndarray], np.ndarray]) -> Signals:
        """The same with entries of values and mask elsewhere."""
        return replace(
            self, values=change(self.values), mask=None if self.mask is None else change(self.mask)
        )

    def rows(self, part: slice | np.ndarray) -> Signals:
        """Some of the rows."""
        of_rows = ("values", "mask", "tx", "rx", "rotation")
        parts = {name: getattr(self, name) for name in of_rows}
        return replace(self, **{name: None if one is None else one[part] for name, one in parts.items()})

    @property
    def wavelength(self) -> float:
        """Of the middle of the tones [m]."""
        assert self.tones is not None
        return LIGHT / float(self.tones.mean())


@dataclass(frozen=True)
class Convention:
    """One that a file may follow.

    Attributes:
        kind: of the measurements.
        words: what it says of them.
        change: to the schema's.
        applies: whether it can be of these.
        tried: whether `check` scores it.
    """

    kind: str
    words: str
    change: Callable[[Signals], Signals]
    applies: Callable[[Signals], bool] = lambda _: True
    tried: bool = True


def _flipped(axis: int) -> Callable[[Signals], Signals]:
    return lambda signals: signals.moved(lambda values: np.flip(values, axis))


def _with_delays(signals: Signals) -> Signals:
    assert signals.tones is not None
    distance = np.linalg.norm(signals.tx - signals.rx, axis=1)
    turns = (signals.tones - signals.tones.mean()) * distance[:, None] / LIGHT
    return replace(signals, values=signals.values * np.exp(-2j * np.pi * turns)[:, None])


def _without_zeros(signals: Signals) -> Signals:
    measured = np.broadcast_to((signals.values != 0).any(axis=(0, 1)), signals.values.shape)
    return replace(signals, mask=measured if signals.mask is None else measured & signals.mask)


def _scaled_array(factor: Callable[[Signals], float]) -> Callable[[Signals], Signals]:
    return lambda signals: replace(signals, array=np.asarray(signals.array) * factor(signals))


def _along(signals: Signals) -> int:
    """Antennas along the axis of a planar array that runs faster in their list; 0 of other arrays."""
    if not _is_array(signals):
        return 0
    place = np.asarray(signals.array)
    cells = np.round((place - place[0]) / max(float(np.ptp(place, axis=0).max()), 1e-9), 4)
    sides = [len(np.unique(cells[:, axis])) for axis in range(3)]
    planar = sorted(sides)[0] == 1 and sorted(sides)[1] > 1 and math.prod(sides) == len(place)
    return sides[int(np.abs(cells[1]).argmax())] if planar else 0


def _other_axis_first(signals: Signals) -> Signals:
    order = np.arange(signals.values.shape[1]).reshape(_along(signals), -1).T.ravel()
    return signals.moved(lambda values: values[:, order])


def _turned(
    change: Callable[[SphereGrid], SphereGrid], axis: int | None = None
) -> Callable[[Signals], Signals]:
    def turned(signals: Signals) -> Signals:
        assert signals.grid is not None
        moved = signals if axis is None else _flipped(axis)(signals)
        return replace(moved, grid=change(signals.grid))

    return turned


def _last(grid: SphereGrid) -> tuple[float, float]:
    """Elevation and azimuth of the last row and column [rad]."""
    elevation = grid.first_elevation + (grid.height - 1) * grid.elevation_step
    return elevation, grid.first_azimuth + (grid.width - 1) * grid.azimuth_step


def _transposed(signals: Signals) -> Signals:
    width, height = signals.values.shape[1:]
    return replace(
        signals.moved(lambda values: values.swapaxes(1, 2)), grid=SphereGrid.hemisphere(height, width)
    )


def _is_array(signals: Signals) -> bool:
    return (
        signals.array is not None and len(signals.array) > 1 and signals.values.shape[1] == len(signals.array)
    )


def _many_tones(signals: Signals) -> bool:
    return signals.values.shape[2] > 2


CONVENTIONS: dict[str, Convention] = {
    "conjugate": Convention(
        "csi", "conjugated channels, exp(+j 2 pi f d / c)", lambda s: replace(s, values=s.values.conj())
    ),
    "exchange_axes": Convention(
        "csi", "the axes of antennas and tones exchanged", lambda s: s.moved(lambda v: v.swapaxes(1, 2)),
        lambda s: s.values.shape[1] == s.values.shape[2] > 1,
    ),
    "fft_order": Convention(
        "csi", "tones in the order of an FFT",
        lambda s: s.moved(lambda v: np.fft.fftshift(v, axes=2)), _many_tones,
    ),
    "reverse_tones": Convention("csi", "tones from the highest to the lowest", _flipped(2), _many_tones),
    "reverse_antennas": Convention("csi", "antennas in reverse order", _flipped(1), _is_array),
    "exchange_array": Convention(
        "csi", "antennas numbered along the other axis of the planar array", _other_axis_first,
        lambda s: _along(s) > 0,
    ),
    "array_mm": Convention(
        "csi", "array_position in millimetres", _scaled_array(lambda _: 1e-3), _is_array
    ),
    "array_wavelengths": Convention(
        "csi", "array_position in wavelengths", _scaled_array(lambda s: s.wavelength), _is_array
    ),
    "swap_iq": Convention(
        "csi", "I and Q swapped", lambda s: replace(s, values=1j * s.values.conj()), tried=False
    ),
    "delays_removed": Convention(
        "csi", "the delay of each row taken out", _with_delays, lambda s: s.values.shape[2] > 1
    ),
    "zeros_unmeasured": Convention("csi", "0 for tones that were not measured", _without_zeros, tried=False),
    "transposed": Convention("spectrum", "rows as azimuths, columns as elevations", _transposed),
    "zenith": Convention(
        "spectrum", "elevation from the zenith",
        _turned(lambda grid: replace(grid, first_elevation=math.pi / 2 - _last(grid)[0]), 1),
        lambda s: s.grid is not None and s.grid.first_elevation >= 0,
    ),
    "clockwise": Convention(
        "spectrum", "clockwise azimuth", _turned(lambda grid: replace(grid, first_azimuth=-_last(grid)[1]), 2)
    ),
    "azimuth_180": Convention(
        "spectrum", "azimuth from -180 degrees",
        _turned(lambda grid: replace(grid, first_azimuth=grid.first_azimuth - math.pi)),
    ),
    "azimuth_north": Convention(
        "spectrum", "azimuth from the y axis",
        _turned(lambda grid: replace(grid, first_azimuth=grid.first_azimuth + math.pi / 2)),
    ),
    "decibels": Convention(
        "spectrum", "decibels",
        lambda s: replace(s, values=10 ** (s.values.astype(np.float64) / 10)), tried=False,
    ),
}  # fmt: skip


def mended(signals: Signals, names: Iterable[str]) -> Signals:
    """Signals of the schema's conventions, from those of a file that follows the ones named.

    Raises:
        DataError: no such convention, or one that cannot be of these measurements.
    """
    chosen = set(names)
    for name in chosen - set(CONVENTIONS):
        raise DataError(
            f"conventions: {name!r} is none of {', '.join(CONVENTIONS)}{nearest(name, CONVENTIONS, 0.4)}"
        )
    for name, one in CONVENTIONS.items():
        if name not in chosen:
            continue
        if one.kind != signals.kind or not one.applies(signals):
            raise DataError(
                f"dataset.{name}: {one.words}: these are {signals.kind} of shape {signals.values.shape[1:]}"
            )
        signals = _in_blocks(signals, one.change)
    return signals


def _in_blocks(signals: Signals, change: Callable[[Signals], Signals]) -> Signals:
    """The same, large values block by block and on disk."""
    if not is_big(signals.values):
        return change(signals)
    first = change(signals.rows(slice(0, 1)))
    values = scratch((len(signals.values), *first.values.shape[1:]), first.values.dtype)
    parts = []
    for part in blocks(signals.values):
        changed = change(signals.rows(part))
        values[part] = changed.values
        parts.append(changed.mask)
    mask = None if parts[0] is None else np.concatenate(parts)
    return replace(signals, values=values, mask=mask, array=first.array, grid=first.grid)
