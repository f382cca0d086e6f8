"""Arrays of a file of the schema: names, shapes, units, as `fields.csv` lists them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gsparc.base.files import read_shipped_table


@dataclass(frozen=True)
class Field:
    """One array of a file.

    Attributes:
        name: of the array.
        shape: allowed; S samples, K frequencies, A antennas, T stations, H x W pixels, P paths, I
            sources.
        unit: required value of `units` where given.
        required: `yes`, `one of`, or when.
        meaning: in words.
        holds: what its entries are, one of `HOLDS`.
        also: what others call it, without regard to case, underlines and dots.
        becomes: of an array of a release, its name in the schema.
    """

    name: str
    shape: str
    unit: str
    required: str
    meaning: str
    holds: str
    also: str = ""
    becomes: str = ""

    @property
    def shapes(self) -> list[tuple[int | str | None, ...]]:
        """Allowed shapes, a letter for a size of its own;
        empty where they follow from another array.

        >>> FIELDS["rx_orientation"].shapes
        [(4,), ('S', 4)]
        """
        parts = [re.findall(r"[^, ][^,]*", part) for part in re.findall(r"\(([^)]*)\)", self.shape)]
        return [tuple(int(a) if a.isdigit() else a for a in part) for part in parts]


FIELDS = {row["name"]: Field(**row) for row in read_shipped_table("gsparc.data", "fields.csv")}

POWER = "uint8 or floating point numbers"
# Kinds of NumPy's dtypes that an array may be of, by the words of messages.
HOLDS = {
    "real numbers": "iuf",
    "whole numbers": "iu",
    "complex numbers": "c",
    "numbers": "ciuf",
    POWER: "uf",
    "True and False": "biuf",
    "text": "US",
    "text or whole numbers": "USiu",
    "text or numbers": "USiufb",
}
NORMALISATIONS = ("max", "minmax", "power", "none")


def list_arrays_with_axis(letter: str) -> dict[str, set[int]]:
    """Return arrays that may have a row per sample (S), station (T) or path (P), and how many axes.

    >>> list_arrays_with_axis("T")["carrier_hz"]  # a frequency for each station
    {1}
    """
    axes = {n: {len(s) for s in field.shapes if s[:1] == (letter,)} for n, field in FIELDS.items()}
    return {name: counts for name, counts in axes.items() if counts}
