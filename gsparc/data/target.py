"""What a target is: facts of spectra, channels and powers, whatever the site."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from gsparc.data.scale import find_strong_outliers, peak_magnitudes, rounded_rms
from gsparc.physics.decibels import RELATIVE_DB, TINY_POWER, finite_decibels, from_decibels

Kind = Literal["spectrum", "csi", "rssi"]
Values = TypeVar("Values", np.ndarray, Tensor)
MOST_DB = 400  # of any level


class Target(ABC):
    """A kind of measurement; rows are first in all arrays.

    Attributes:
        kind: its name in files and settings.
        called: several of them, in words.
        arrays: of a file (`gsparc/data/fields.csv`) that may hold it.
        types: of entries, as they are stored and as they are scaled.
        numbers: real numbers of an entry.
        exponent: of an entry's magnitude that is its power.
        axes: of an array of them, rows among them.
        is_complex: whether entries have a phase.
        is_image: whether its entries lie beside each other, as directions.
        is_level: whether it is one received level, whose errors are counted in decibels.
        loss: of which the first printed figure is a mean: of squared errors, or of their
            logarithms.
    """

    kind: ClassVar[Kind]
    called: ClassVar[str]
    arrays: ClassVar[tuple[str, ...]]
    types: ClassVar[tuple[type[np.generic], type[np.generic]]] = np.float32, np.float64
    numbers: ClassVar[int] = 1
    exponent: ClassVar[int] = 2
    axes: ClassVar[int] = 3
    is_complex: ClassVar[bool] = False
    is_image: ClassVar[bool] = False
    is_level: ClassVar[bool] = False
    loss: ClassVar[Literal["square", "log"]] = "square"

    def fault(self, array: str) -> tuple[Callable[[np.ndarray], np.ndarray], str] | None:
        """Return what tells entries that an array of a file cannot hold, and what it holds;
        None where any number may be.
        """
        return None

    def linear(self, array: str, values: np.ndarray) -> np.ndarray:
        """Return values of an array of a file in linear units."""
        return values

    @abstractmethod
    def scale(self, values: np.ndarray, mask: np.ndarray | None) -> float:
        """Return the constant of a site that its linear values (S, ...) are divided by;
        0 where all are silent.
        """

    @abstractmethod
    def describe(self, count: int, shape: tuple[int, ...]) -> str:
        """Return how many of which shape (`shape` of one) there are, for people."""

    def to_real(self, target: np.ndarray) -> np.ndarray:
        """Return stored targets (n, ...) as float32 rows (n, D),
        in units in which interpolation is fair.

        >>> TARGETS["rssi"].to_real(np.array([[1.0], [0.1]])).tolist()
        [[0.0], [-10.0]]
        """
        return target.reshape(len(target), -1).astype(np.float32)

    @abstractmethod
    def to_targets(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return rows (B, D) of `to_real` as targets (B, *shape) in stored units."""

    def entry_variance(self, variance: Tensor, mean: Tensor) -> Tensor:
        """Turn the variance (B,) per real number of `to_real` into the squared error (B,) expected
        per entry about targets `mean` (B, ...).
        """
        return variance * self.numbers

    def in_error_unit(self, values: Tensor) -> Tensor:
        """Return values in the unit that errors are counted in."""
        return values

    def moments_in_error_unit(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return means (B, ...) and the variance (B,) or (B, 1) of their entries,
        in the unit of errors.
        """
        return self.in_error_unit(mean), variance

    def blend(self, first: Tensor, second: Tensor, weight: float) -> Tensor:
        """Return the mean (n, ...) of two in the unit of errors, the second's of this weight."""
        return first.lerp(second, weight)

    def power(self, values: Values) -> Values:
        """Return the power of entries (...) in physical units, float64."""
        magnitude = abs(values)
        double = (
            magnitude.double() if isinstance(magnitude, Tensor) else magnitude.astype(np.float64)
        )
        return double**self.exponent


class Spectrum(Target):
    """Amplitudes over directions (H, W), in [0, 1]."""

    kind, called, arrays = "spectrum", "spectra", ("spectrum",)
    is_image, loss = True, "log"

    def fault(self, array: str) -> tuple[Callable[[np.ndarray], np.ndarray], str] | None:
        """See `Target.fault`."""
        wanted = "linear power, at least 0 (is it in dB?; then dataset.decibels=true)"
        return lambda part: part < 0, wanted

    def scale(self, values: np.ndarray, mask: np.ndarray | None) -> float:
        """Return the largest but for outliers; 1 where that is about 1; see `Target.scale`."""
        highest = peak_magnitudes(values)
        largest = float(highest[~find_strong_outliers(highest)].max(initial=0.0))
        return 1.0 if 0.1 <= largest <= 1 else largest

    def describe(self, count: int, shape: tuple[int, ...]) -> str:
        """See `Target.describe`."""
        return f"{count} images of {shape[0]} x {shape[1]} directions"

    def to_real(self, target: np.ndarray) -> np.ndarray:
        """Return pixels in [0, 1]; see `Target.to_real`."""
        rows = super().to_real(target)
        return rows / np.float32(255) if target.dtype == np.uint8 else rows

    def to_targets(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return images clamped to [0, 1]; see `Target.to_targets`."""
        return rows.reshape(len(rows), *shape).clamp(0.0, 1.0)


class Channel(Target):
    """Complex gains (antennas, subcarriers)."""

    kind, called, arrays = "csi", "channels", ("csi",)
    types = np.complex64, np.complex128
    numbers = 2
    is_complex = True

    def scale(self, values: np.ndarray, mask: np.ndarray | None) -> float:
        """Return the root mean square; see `Target.scale`."""
        return rounded_rms(values, mask)

    def describe(self, count: int, shape: tuple[int, ...]) -> str:
        """See `Target.describe`."""
        many = ["s" * (n != 1) for n in shape]
        return f"{count} channels of {shape[0]} antenna{many[0]} x {shape[1]} subcarrier{many[1]}"

    def to_real(self, target: np.ndarray) -> np.ndarray:
        """Return real and imaginary parts in linear units; see `Target.to_real`."""
        # ascontiguousarray: a view as pairs needs the last axis dense.
        return (
            np.ascontiguousarray(target, dtype=np.complex64)
            .reshape(len(target), -1)
            .view(np.float32)
        )

    def to_targets(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """See `Target.to_targets`."""
        return torch.view_as_complex(rows.reshape(len(rows), *shape, 2))


class Power(Target):
    """Received powers (1,), linear; their errors are of decibels."""

    kind, called, arrays = "rssi", "powers", ("rssi", "rssi_db")
    is_level = True
    exponent = 1
    axes = 2

    def fault(self, array: str) -> tuple[Callable[[np.ndarray], np.ndarray], str] | None:
        """See `Target.fault`."""
        if array == "rssi_db":
            return lambda part: np.abs(part) > MOST_DB, f"dB between -{MOST_DB} and {MOST_DB}"
        return lambda part: part < 0, "linear power, at least 0 (is it in dB?)"

    def linear(self, array: str, values: np.ndarray) -> np.ndarray:
        """See `Target.linear`."""
        return from_decibels(values) if array == "rssi_db" else values

    def scale(self, values: np.ndarray, mask: np.ndarray | None) -> float:
        """Return the mean in whole decibels; see `Target.scale`."""
        return rounded_rms(np.sqrt(values), mask) ** 2

    def describe(self, count: int, shape: tuple[int, ...]) -> str:
        """See `Target.describe`."""
        return f"{count} received powers"

    def to_real(self, target: np.ndarray) -> np.ndarray:
        """Return decibels; see `Target.to_real`."""
        return finite_decibels(super().to_real(target))

    def to_targets(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        """See `Target.to_targets`."""
        return from_decibels(rows.reshape(len(rows), *shape))

    def entry_variance(self, variance: Tensor, mean: Tensor) -> Tensor:
        """Carry decibels to linear power, to first order; see `Target.entry_variance`."""
        return variance * (mean.flatten(1).mean(1) / RELATIVE_DB) ** 2

    def in_error_unit(self, values: Tensor) -> Tensor:
        """Return levels [dB]."""
        return finite_decibels(values)

    def moments_in_error_unit(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return levels [dB] and their variance, to first order."""
        slope = RELATIVE_DB / mean.to(variance.dtype).reshape(variance.shape).clamp_min(TINY_POWER)
        return self.in_error_unit(mean), variance * slope.square()

    def blend(self, first: Tensor, second: Tensor, weight: float) -> Tensor:
        """Return a mean of levels; see `Target.blend`."""
        return first.clamp_min(TINY_POWER) ** (1 - weight) * second.clamp_min(TINY_POWER) ** weight


TARGETS: dict[Kind, Target] = {target.kind: target for target in (Spectrum(), Channel(), Power())}
MEASUREMENTS = {array: target for target in TARGETS.values() for array in target.arrays}
