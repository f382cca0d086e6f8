"""Units that stand in the heads of columns, and what they are times the schema's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Unit:
    """A unit as people write it.

    Attributes:
        name: as messages write it.
        kind: `length`, `angle`, `frequency`, `power` or `level`; one kind has one unit in the schema.
        factor: multiplies a value.
        offset: is added after that.
    """

    name: str
    kind: str
    factor: float = 1.0
    offset: float = 0.0

    def convert(self, values: np.ndarray) -> np.ndarray:
        """Values of this unit in the schema's unit of its kind."""
        return values if (self.factor, self.offset) == (1.0, 0.0) else values * self.factor + self.offset

    @property
    def changes(self) -> bool:
        """Whether `convert` does anything."""
        return (self.factor, self.offset) != (1.0, 0.0)


SCHEMA = {"length": "m", "angle": "deg", "frequency": "Hz", "power": "W", "level": "dBm"}
_LISTED = [
    *(Unit(name, "length", factor) for name, factor in (("m", 1.0), ("mm", 1e-3), ("cm", 1e-2), ("km", 1e3))),
    *(Unit(name, "length", 0.3048) for name in ("ft", "feet")),
    *(Unit(name, "length") for name in ("meter", "metre", "meters", "metres")),
    *(Unit(name, "angle") for name in ("deg", "°", "degree", "degrees")),
    *(Unit(name, "angle", 180 / np.pi) for name in ("rad", "radians")),
    *(Unit(n, "frequency", f) for n, f in (("Hz", 1.0), ("kHz", 1e3), ("MHz", 1e6), ("GHz", 1e9))),
    *(Unit(n, "power", f) for n, f in (("W", 1.0), ("mW", 1e-3), ("uW", 1e-6), ("µW", 1e-6), ("nW", 1e-9))),
    *(Unit(n, "power", f) for n, f in (("pW", 1e-12), ("fW", 1e-15))),
    *(Unit("dB", "level"), Unit("dBm", "level"), Unit("dBW", "level", offset=30.0)),
]
# Without case: nobody receives megawatts.
UNITS = {unit.name.lower(): unit for unit in _LISTED} | {"μw": Unit("µW", "power", 1e-6)}


def known(kind: str) -> str:
    """The units of a kind, for messages."""
    return ", ".join(unit.name for unit in _LISTED if unit.kind == kind)
