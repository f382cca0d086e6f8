"""Units as people write them, and the only way between stored powers and the unit
that they were given in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from torch import Tensor

from gsparc.base.files import read_shipped_table
from gsparc.physics.decibels import RELATIVE_DB, from_decibels, to_decibels


@dataclass(frozen=True)
class Unit:
    """A unit as people write it.

    Attributes:
        name: as messages write it.
        kind: `length`, `angle`, `frequency`, `power` or `level`; one kind has one unit in the
            schema.
        factor: multiplies a value.
        offset: is added after that.
        times: the part of the factor that a setting gives, as it was written; empty: none.
    """

    name: str
    kind: str
    factor: float = 1.0
    offset: float = 0.0
    times: str = ""

    def convert(self, values: np.ndarray) -> np.ndarray:
        """Convert values of this unit to the schema's unit of its kind."""
        return (
            values
            if (self.factor, self.offset) == (1.0, 0.0)
            else values * self.factor + self.offset
        )

    @property
    def changes(self) -> bool:
        """Whether `convert` does anything."""
        return (self.factor, self.offset) != (1.0, 0.0)


SCHEMA = {"length": "m", "angle": "deg", "frequency": "Hz", "power": "W", "level": "dBm"}
_LISTED = [
    Unit(row["name"], row["kind"], float(row["factor"]), float(row["offset"]))
    for row in read_shipped_table("gsparc.data", "units.csv")
]
# Without case: nobody receives megawatts.
UNITS = {unit.name.lower(): unit for unit in _LISTED} | {"μw": Unit("µW", "power", 1e-6)}


def list_units(kind: str) -> str:
    """List the units of a kind, for messages."""
    return ", ".join(unit.name for unit in _LISTED if unit.kind == kind)


WATTS = {unit.name: unit.factor for unit in _LISTED if unit.kind == "power"}  # that a value of 1 is
WATTS |= {"dBW": 1.0, "dBm": 1e-3}  # of levels the power of 0
LINEAR = "linear"  # a power whose level is in the site's unit of levels, whatever that refers to


@dataclass(frozen=True)
class PowerUnit:
    """Between linear powers as they are stored and values in a unit.

    Attributes:
        name: of the unit.
        decibels: whether values are levels.
        scale: value of a stored power of 1, or the power whose level that value is.
    """

    name: str
    decibels: bool
    scale: float

    @classmethod
    def from_name(
        cls, name: str | None, level_unit: str, scale: float = 1.0, levels: bool = False
    ) -> Self:
        """Return the unit of a name, for stored powers
        that times `scale` have levels in `level_unit`.

        Levels whose reference nobody said (`dB`) are in whatever unit of levels is asked for.

        Args:
            name: None: that of the levels.
            level_unit, scale: of the stored powers.
            levels: whether powers as such are refused.

        Raises:
            ValueError: no unit of powers, or one that these powers cannot be turned into.
        """
        if name in (None, level_unit) or (name == LINEAR and not levels):
            return cls(name or level_unit, name != LINEAR, scale)
        unit, watt = UNITS.get(str(name).lower()), WATTS.get(level_unit)
        decibels = unit is not None and unit.kind == "level"
        if unit is None or unit.name not in WATTS or (not decibels and (levels or watt is None)):
            powers = (
                ""
                if levels
                else f", {LINEAR}"
                if watt is None
                else (f", {LINEAR}, {list_units('power')}")
            )
            raise ValueError(f"unit={name}: of powers in {level_unit} expected dBm, dBW{powers}")
        return cls(unit.name, decibels, scale if watt is None else scale * watt / WATTS[unit.name])

    @property
    def raised_db(self) -> float:
        """What is added to the level [dB] of a stored power."""
        return 10 * math.log10(self.scale)

    def values(self, stored: Tensor) -> Tensor:
        """Return powers in the unit, like `stored`;
        levels are -inf of silence and NaN of what is less.
        """
        if self.decibels:
            return to_decibels(stored.double()) + self.raised_db
        return stored if self.scale == 1 else stored * self.scale

    def variance(self, stored: Tensor, variance: Tensor) -> Tensor:
        """Return the variance (B,) of `values`, from stored powers (B, 1)
        or other targets and theirs (B,).

        Powers (B, T) of several stations have variances (B, T).

        In float64: squares of powers in watts are beyond float32.
        """
        if self.decibels:
            return (
                variance.double() * (RELATIVE_DB / stored.double().reshape(variance.shape)).square()
            )
        return variance.double() * self.scale**2

    def stored(self, values: Tensor) -> Tensor:
        """Invert `values`, in float64."""
        values = values.double()
        return from_decibels(values - self.raised_db) if self.decibels else values / self.scale


def power_in_decibels(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and deviation (n,) [dB] of powers of `mean` and `variance` (n,),
    linear and above 0.
    """
    return to_decibels(mean), RELATIVE_DB * np.sqrt(variance) / mean
