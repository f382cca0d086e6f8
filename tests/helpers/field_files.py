"""Files of exported fields with several fields changed together, their checksums made right."""

import struct
import zlib

import numpy as np

from gsparc.apps.export.compiled.blob import CHECKED, HEAD, SECTION, Form, pack_form

SIZES = {
    1: (0, 1, 2, 7, 8, 9, 10, 11, 12, 13),
    2: (0, 1, 2, 7, 8, 9),
    3: tuple(range(15)),
    4: (0, 1, 2, 3, 4),
    5: (0, 1),
}
WHOLE = [
    0,
    1,
    2,
    3,
    4,
    6,
    7,
    8,
    15,
    16,
    17,
    31,
    64,
    255,
    1024,
    4095,
    4096,
    46341,
    65535,
    65536,
    *2 ** np.arange(17, 27),
]
ODD = [np.nan, np.inf, -np.inf, -1, 0, 0.5, 1e-300, 1e300, -1e9, 2.0**31, 2.0**53, 2.0**63]
MOST = 1 << 22  # numbers of an array that is made longer


def needed(kind: int, n: list[int]) -> dict[str, int]:
    """Numbers that each array of a form of these sizes has, as the constructors say."""
    if kind == 1:
        axes, anchors, count, elements, height, columns, lags0, waves0, lags1, waves1 = n
        parts = 2 * elements + 2
        wide = columns * (2 if waves1 else 1)
        return {
            "at": anchors * axes,
            "whitening": anchors * count,
            "weights": count * parts,
            "offset": parts,
            "pairs": 2 * elements**2 * (lags0 + lags1),
            "table0": lags0 * height * waves0,
            "wave0": waves0 * columns,
            "table1": lags1 * height * waves1,
            "wave1": waves1 * columns,
            "square": height * wide,
        }
    if kind == 2:
        axes, anchors, count, seen, height, width = n
        return {
            "at": anchors * axes,
            "whitening": anchors * count,
            "weights": count * seen,
            "offset": seen,
            "means": 3 * seen,
            "starts": -(-height // 4) * -(-width // 4) + 1,
        }
    if kind == 3:
        count, rows, outputs, antennas, still, combs, searches, tellers, rank = n[:9]
        watchers, blurred, variants, steps, boxes, patches = n[9:]
        padded, wide, watching = (-(-size // 16) * 16 for size in (rows, tellers, watchers))
        axes, told = 6 if still > 1 else 3, count if tellers else 0
        hiding = {"still": 3, "legs": count * variants * (1 + 9 * steps)}
        return {
            "counts": searches,
            "shares": searches,
            "watch": 3 * watching,
            "watch_by": count if watchers else 0,
            "watch_level": count if watchers else 0,
            "watch_weights": count * watching,
            "blur": blurred,
            "blur_by": 9 * blurred,
            "blur_rows": 3 * blurred * padded,
            "teller": tellers,
            "phasor": 2 * told,
            "power": told,
            "there": told * 2 * wide,
            "root": rank * 2 * wide,
            **(hiding if boxes or patches else {}),
            "boxes": 7 * boxes,
            "patches": 16 * patches,
            "moving": antennas * 3,
            "sources": count * 3,
            "images": still * count * 3,
            "combs": combs * 3,
            "by_angle": count,
            "by_length": count,
            "places": axes * padded,
            "towards": count * 3 * padded,
            "level": count * 2 * outputs,
            "weights": count * 2 * outputs * padded,
            "offsets": still * 3 if still > 1 else 0,
            "factors": 2 * antennas * still * outputs,
        }
    if kind == 5:  # members are files of their own
        return {}
    axes, rows, _, sets, terms = n
    return {
        "places": rows * axes,
        "columns": axes * (-(-rows // 8) * 8),
        "extra": rows,
        "values": rows,
        "slopes": rows * terms,
        "weighed": terms,
        "unsure": terms**2,
        "root": rows * (rows + 1) // 2,
        "sets": 3 * sets,
    }


def an_array() -> Form:
    """A small spectrum of a static array, of any numbers."""
    draw, sizes = np.random.default_rng(0), [3, 5, 4, 3, 6, 5, 3, 2, 2, 2]
    arrays = {
        name: draw.normal(size=count).astype(np.float32) for name, count in needed(1, sizes).items()
    }
    return Form(1, [float(one) for one in [*sizes[:3], 0, 1, 1, 2, *sizes[3:]]], arrays)


def mutated(form: Form, draw: np.random.Generator) -> bytes:
    """Sizes, numbers, elements of arrays and the table otherwise; arrays often as long as fits."""
    numbers, arrays = (
        list(form.numbers),
        {name: value.ravel().copy() for name, value in form.arrays.items()},
    )
    sizes = SIZES[form.kind]
    for at in draw.choice(sizes, draw.integers(0, 5)):
        now = numbers[at]
        numbers[at] = float(draw.choice([*WHOLE, now - 1, now + 1, 2 * now, now // 2]))
    if large := draw.random() < 0.02:
        for at in sizes:
            numbers[at] = min(numbers[at], float(draw.integers(1, 3)))
        one, other = draw.choice(sizes, 2, replace=False)
        power = int(draw.integers(12, 21))
        numbers[one], numbers[other] = 2.0**power, 2.0 ** (draw.integers(31, 33) - power)
    elif draw.random() < 0.3:
        for at in draw.integers(0, len(numbers), draw.integers(1, 4)):
            numbers[at] = float(draw.choice([*ODD, *WHOLE]))
    fits, most = draw.random() < 0.8, MOST if large else MOST >> 9
    if fits and all(0 <= numbers[at] < 2**26 and numbers[at] % 1 == 0 for at in sizes):
        for name, count in needed(form.kind, [int(numbers[at]) for at in sizes]).items():
            # As an int product would have it
            wrapped = count % 2**32 if draw.random() < 0.5 else count
            if name in arrays and arrays[name].size and wrapped <= most:
                arrays[name] = np.resize(arrays[name], wrapped)
    if fits and form.kind == 2 and arrays["starts"].size:
        blocks = arrays["ranks"].size
        arrays["starts"] = np.linspace(0, blocks, arrays["starts"].size).astype(np.int64)
    if fits and form.kind == 4 and arrays["sets"].size >= 3:
        _even_sets(numbers, arrays, draw)
    for name in draw.choice(list(arrays), draw.integers(0, 3)) if draw.random() < 0.6 else ():
        value = arrays[name]
        for at in draw.integers(0, value.size, draw.integers(1, 4)) if value.size else ():
            low = np.iinfo(value.dtype).min if value.dtype.kind == "i" else -np.inf
            some = [low, -1, 0, 1, value.size, value[at] + 1, 2**31 - 1] + (
                ODD if value.dtype.kind == "f" else []
            )
            with np.errstate(over="ignore"):
                value[at] = some[draw.integers(len(some))]
    if fits and form.kind == 3 and arrays["counts"].size:
        # All of one search: told by as many sources as `needed` says.
        arrays["counts"] = np.resize([numbers[0], 0], arrays["counts"].size).astype(np.int32)
    blob = bytearray(
        pack_form(Form(form.kind, numbers, arrays), np.zeros(3), float(draw.random() < 0.5))
    )
    if draw.random() < 0.3:
        _other_table(blob, draw)
    return with_checksum(blob)


def _even_sets(
    numbers: list[float], arrays: dict[str, np.ndarray], draw: np.random.Generator
) -> None:
    """Trees over all rows, their neighbours as many as are said, boxes of their nodes."""
    many, rows = arrays["sets"].size // 3, int(np.clip(np.nan_to_num(numbers[1]), 0, MOST))
    cut = np.linspace(0, rows, many + 1).astype(np.int64)
    near = np.minimum(np.diff(cut), draw.integers(0, 40))
    depth = draw.integers(0, 8, many)
    arrays["sets"] = np.stack([np.diff(cut), near, depth], 1).ravel()
    numbers[2] = float(near.sum())
    if arrays["boxes"].size and numbers[0] in (1, 2, 3, 6):
        arrays["boxes"] = np.resize(arrays["boxes"], int(((2 << depth) - 1).sum() * 2 * numbers[0]))


def _other_table(blob: bytearray, draw: np.random.Generator) -> None:
    """Fields of the header and of the sections' table otherwise."""
    many = HEAD.unpack(blob[: HEAD.size])[-1]
    for _ in range(draw.integers(1, 4)):
        at = HEAD.size + SECTION.size * int(draw.integers(many))
        name, kind, unused, offset, count = SECTION.unpack(blob[at : at + SECTION.size])
        other = SECTION.unpack_from(blob, HEAD.size + SECTION.size * int(draw.integers(many)))
        some = [
            count % 2**40 + 1,
            2 * (count % 2**40),
            0,
            2**62,
            -1,
            (len(blob) - offset) // 4,
            other[4],
        ]
        fields = [
            (other[0], kind, unused, offset, count),
            (name, int(draw.integers(6)), unused, offset, count),
            (
                name,
                kind,
                unused,
                int(draw.choice([0, 64, len(blob) // 64 * 64, -64, 2**62])),
                count,
            ),
            (name, kind, unused, offset, int(some[draw.integers(len(some))])),
        ]
        blob[at : at + SECTION.size] = SECTION.pack(*fields[draw.integers(len(fields))])
    if draw.random() < 0.1:
        blob[24:32] = struct.pack("<q", int(draw.choice([0, -1, many + 1, many - 1, 2**40])))


def with_checksum(blob: bytearray) -> bytes:
    """The same, its checksum right."""
    blob[12:16] = struct.pack("<I", zlib.crc32(bytes(blob[CHECKED:])))
    return bytes(blob)
