"""Arrays of a published layout: all there, of the right shapes and types, with finite places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gsparc.data.assemble import FARTHEST, bad_positions
from gsparc.data.errors import Problems
from gsparc.data.raw import Raw

REAL, COMPLEX, FLAGS, TEXT, LABELS = "iuf", "c", "biuf", "US", "USiu"  # kinds of NumPy's dtypes
IN_WORDS = {
    REAL: "real numbers",
    COMPLEX: "complex numbers",
    FLAGS: "True and False",
    TEXT: "text",
    LABELS: "text or whole numbers",
}


@dataclass(frozen=True)
class Expected:
    """One array of a layout.

    Attributes:
        shape: per axis a size, or a letter that stands for the same size in all arrays.
        kinds: allowed kinds of NumPy's dtypes, one of those above.
        place: whether rows are coordinates [m], all of which must be finite and on Earth.
        optional: whether the array may be absent.
    """

    shape: tuple[str | int, ...]
    kinds: str = REAL
    place: bool = False
    optional: bool = False


def check_layout(raw: Raw, source: str | Path, layout: Mapping[str, Expected]) -> None:
    """Refuse arrays that do not fit `layout`; a letter's size is that of the first array that has it.

    Raises:
        DataError: all that is missing, of another shape or type, or no place, with array and row.
    """
    problems = Problems(source)
    sizes: dict[str, tuple[int, str]] = {}
    for name, expected in layout.items():
        where, array = f"{source}, {name}", raw.arrays.get(name)
        if array is None:
            if not expected.optional:
                problems.add(where, f"missing; expected {IN_WORDS[expected.kinds]} {_text(expected.shape)}")
        elif array.dtype.kind not in expected.kinds:
            problems.add(where, f"expected {IN_WORDS[expected.kinds]}, found dtype {array.dtype}")
        elif not _fits(array.shape, expected.shape, sizes):
            problems.add(where, _misfit(array.shape, expected.shape, sizes))
        else:
            for letter, size in zip(expected.shape, array.shape, strict=True):
                if isinstance(letter, str):
                    sizes.setdefault(letter, (size, name))
            if expected.place:
                bad = bad_positions(array)
                rows = (f"row {i} = ({', '.join(f'{x:g}' for x in array[i])})" for i in bad)
                what = f"expected finite coordinates in metres, none beyond {FARTHEST:.0e}"
                problems.add_rows(where, rows, what)
    problems.raise_if_any()


def _fits(found: tuple[int, ...], shape: tuple[str | int, ...], sizes: Mapping[str, tuple[int, str]]) -> bool:
    if len(found) != len(shape):
        return False
    wanted = (sizes.get(axis, (None,))[0] if isinstance(axis, str) else axis for axis in shape)
    return all(want is None or want == got for want, got in zip(wanted, found, strict=True))


def _misfit(
    found: tuple[int, ...], shape: tuple[str | int, ...], sizes: Mapping[str, tuple[int, str]]
) -> str:
    known = [f"{a} = {sizes[a][0]} as in {sizes[a][1]}" for a in shape if isinstance(a, str) and a in sizes]
    here = f" with {', '.join(known)}" if known else ""
    turned = len(found) > 1 and found != found[::-1] and _fits(found[::-1], shape, sizes)
    return f"expected shape {_text(shape)}{here}, found {found}{'; transposed?' if turned else ''}"


def _text(shape: tuple[str | int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
