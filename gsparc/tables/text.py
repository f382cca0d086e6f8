"""Cells of a file of text: encoding, delimiters, banners, comments, decimal marks, limits."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections import Counter
from pathlib import Path

import pandas as pd

from gsparc.base.errors import Caution, DataError, Problems, name_row_ranges, readable
from gsparc.base.files import check_content, check_line_length
from gsparc.base.limits import LIFTED_BY, MOST_CELLS, MOST_COLUMNS, most_text_bytes
from gsparc.tables.heads import SHEET, parse_head
from gsparc.tables.sheet import Sheet

DECIMAL_COMMA = r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*"
GZIP = b"\x1f\x8b"
DECIMAL_POINT = r"\s*[-+]?\d*\.\d+(?:[eE][-+]?\d+)?\s*"
DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
THOUSANDS = r"\s*[-+]?[1-9]\d{0,2},\d{3}\s*"  # 448,262: a mark between thousands, or three decimals
LOOKED_AT = 200  # lines and cells that decide about delimiter and decimal mark
COMMENTS = ("#", "%", "//")


Lines = dict[int, str]  # those with something in them, by their numbers from 1


def read_text(path: Path) -> Sheet:
    """Read the cells of a text file, with notes on what was recognised.

    Raises:
        DataError: empty, not text, no heads, ragged lines or two columns of one name.
    """
    source, notes = str(path), list[str]()
    text, encoding = _decoded(path)
    if encoding != "UTF-8":
        notes.append(f"read as {encoding}")
    lines, comment = _lines(MINUS.sub("-", text), source)
    if not lines:
        raise DataError(f"{source}: empty; expected a line of heads and rows below it")
    lines = _without_banner(lines, notes)
    if re.fullmatch("sep=.", lines[min(lines)].strip()) and len(lines) > 1:  # Excel's own hint
        del lines[min(lines)]
    delimiter = _delimiter([*lines.values()], comment)
    if delimiter is None:
        fault = f"line {min(lines)} ({lines[min(lines)][:40]!r}) is a single column"
        raise DataError(f"{source}: {fault}; expected commas, semicolons or tabs between several")
    width = len(_cells(lines[min(lines)], delimiter))
    if width > MOST_COLUMNS or width * len(lines) > MOST_CELLS:
        fault = (
            f"{width:,} columns of {len(lines):,} lines; at most {MOST_COLUMNS:,} and "
            f"{MOST_CELLS:,}"
        )
        how = "write Parquet, of means by cells of places where rows are many"
        raise DataError(f"{source}: {fault} cells are read: {how}")
    lines = _with_heads(lines, comment, delimiter, source)
    lines = _without_comments(_heads_once(lines, delimiter, notes), delimiter, source, notes)
    heads, *rows = _rectangular(lines, delimiter, source)
    heads = [cell.strip() for cell in heads]
    for i, head in enumerate(heads):
        if head and head in heads[:i]:
            where = f"columns {heads.index(head) + 1} and {i + 1}"
            hint = "; is there no line of heads?" if _is_number(head) else "; rename one"
            raise DataError(f"{source}: {where} are both named {head!r}{hint}")
    if not rows:
        raise DataError(
            f"{source}: line {min(lines)} names columns, but there are no rows below it"
        )
    frame = pd.DataFrame(rows, dtype=object)
    if delimiter != ",":
        notes.append(f"{DELIMITERS.get(delimiter, repr(delimiter))} between columns")
    decimal = _decimal(text, frame, delimiter, notes)
    named = frame.set_axis(heads, axis=1)[[head for head in heads if head]]
    return Sheet(source, named, tuple(f"line {n}" for n in lines)[1:], decimal, notes=notes)


def _decoded(path: Path) -> tuple[str, str]:
    """The text of a file and the name of its encoding."""
    with path.open("rb") as file:
        packed = file.read(len(GZIP)) == GZIP
    most = most_text_bytes(path.stat().st_size if packed else None)
    with (
        readable(
            path, "damaged or not compressed by gzip", (EOFError, zlib.error, gzip.BadGzipFile)
        ),
        gzip.open(path) if packed else path.open("rb") as file,
    ):
        content = file.read(most + 1)
    check_bytes(path, len(content), most)
    check_content(path, content, "\n\r")
    for start, format_name in SHEET["others"].items():
        if content.lstrip().startswith(start.encode("latin-1")):
            raise DataError(f"{path}: not a table of text but {format_name}")
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return content.decode("utf-16"), "UTF-16"
        except UnicodeDecodeError as error:
            raise DataError(
                f"{path}: damaged UTF-16 at byte {error.start}; save it as UTF-8"
            ) from None
    if content.startswith((b"II*\0", b"MM\0*")):
        raise DataError(
            f"{path}: a raster (TIFF), squares of a map; give the table of the rows that were "
            "measured, "
            f"and beside it model.prior={path}"
        )
    if b"\0" in content:
        why = f"byte {content.index(0)} is zero; UTF-16 without its mark?"
        how = "export a table of text (CSV); logs of Wi-Fi channels are read by dataset=wifi_csi"
        raise DataError(f"{path}: not text ({why}); {how}")
    try:
        return content.decode("utf-8-sig"), "UTF-8"
    except UnicodeDecodeError:
        # Every byte means something in Latin-1; Windows-1252 is what spreadsheets write.
        return content.decode("cp1252", errors="replace"), "Windows-1252, as it is not UTF-8"


def check_bytes(path: Path, count: int, most: int) -> None:
    """Refuse a file of more than `most` bytes of text."""
    if count > most:
        unpacked = " when it is unpacked" if path.stat().st_size <= most else ""
        advice = f"write it as Parquet, or set {LIFTED_BY}=N where memory has twenty times as many"
        raise DataError(f"{path}: a table of text of more than {most:,} bytes{unpacked}; {advice}")


def _lines(text: str, source: str) -> tuple[Lines, str]:
    """The lines, and the last comment before the first of them."""
    lines: Lines = {}
    comment, number = "", 1
    text = QUOTED.sub(_in_one_line, text) if '"' in text else text
    # Not str.splitlines, which also ends lines at characters that may stand in a cell.
    for line in re.split(BREAK, text):
        stripped = check_line_length(source, number, line).strip()
        if stripped.startswith(COMMENTS) and not lines:
            comment = stripped.lstrip("#%/ ")
        elif stripped.strip(",;\t |"):  # spreadsheets write empty lines as delimiters alone
            lines[number] = line.replace(BROKEN, " ")
        number += 1 + line.count(BROKEN)
    return lines, comment


BREAK, BROKEN = r"\r\n|\n|\r", "\x1f"
QUOTED = re.compile(r'(?m)(?:^|(?<=[,;\t|])) *"[^"]*(?:""[^"]*)*"(?= *(?:[,;\t|\r\n]|\Z))')
MOST_BROKEN = 20  # lines of a cell: of more, a quotation mark was not closed


def _in_one_line(cell: re.Match[str]) -> str:
    """A quoted cell with `BROKEN` for breaks of lines; as it is where they are too many."""
    line, count = re.subn(BREAK, BROKEN, cell[0])
    return line if count < MOST_BROKEN else cell[0]


MINUS = re.compile(r"(?<![^\s,;|\"'])[\u2212\u2013\u2010\u2011\ufe63\uff0d](?=\s?[\d.,])")
MOST_ABOVE = 10  # lines above the heads


def _without_banner(lines: Lines, notes: list[str]) -> Lines:
    """The lines from the heads on, where lines above them
    that hold something else leave no doubt.
    """
    numbers = list(lines)[:LOOKED_AT]
    for delimiter in DELIMITERS:
        cells = [_cells(lines[n], delimiter) for n in numbers]
        usual = Counter(map(len, cells)).most_common(1)[0][0]
        named = {
            cell: bool(parse_head(cell).role) for row in cells[:MOST_ABOVE] for cell in set(row)
        }
        roles = [sum(named[cell] for cell in row) for row in cells[:MOST_ABOVE]]
        first = next(
            (i for i, count in enumerate(roles) if count > 1 and len(cells[i]) == usual), 0
        )
        above = [
            len(row) != usual or 2 * sum(c.strip() != "" for c in row) <= usual
            for row in cells[:first]
        ]
        if usual > 1 and first and all(above) and 2 * max(roles[:first]) < roles[first]:
            above_them = f"left out above: {lines[numbers[0]][:40]!r}"
            notes.append(f"the heads stand in line {numbers[first]}; {above_them}")
            return {n: line for n, line in lines.items() if n >= numbers[first]}
    return lines


def _heads_once(lines: Lines, delimiter: str, notes: list[str]) -> Lines:
    """The lines without those that repeat the heads, with what is written above."""
    (first, *below), again, above = lines, set[int](), list[int]()
    for n in below:
        text = lines[n].strip("\ufeff \t")
        again |= {n, *above} if text == lines[first].strip() else set()
        titled = text.startswith(COMMENTS) or len(_cells(text, delimiter)) == 1
        above = [*above, n] if titled else []
    if again:
        where = name_row_ranges([f"line {n}" for n in sorted(again)])
        question = "the heads again; left out: are these files joined that belong together?"
        notes.append(Caution(f"{where}: {question}"))
    return {n: text for n, text in lines.items() if n not in again}


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        line = " ".join(line.split())
    if '"' not in line:
        return line.split(delimiter)
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))


def _delimiter(lines: list[str], comment: str) -> str | None:
    """The one by which heads in a comment, then most lines, have as many cells as the first,
    and not one.
    """
    sample = lines[:LOOKED_AT]

    def suits(delimiter: str) -> tuple[bool, bool, bool, float, int]:
        count = len(_cells(sample[0], delimiter))
        named = _cells(comment, delimiter) if comment else []
        heads = len(named) == count and any(parse_head(cell).role for cell in named)
        agree = sum(len(_cells(line, delimiter)) == count for line in sample) / len(sample)
        return count > 1, heads, delimiter != " ", agree, count  # spaces may stand in cells

    best = max(DELIMITERS, key=suits)
    return best if suits(best)[0] else None


def _with_heads(lines: Lines, comment: str, delimiter: str, source: str) -> Lines:
    """The lines, the first of them heads; a comment before values is taken
    for them where it fits.
    """
    first = _cells(lines[min(lines)], delimiter)
    heads = _cells(comment, delimiter) if comment else []
    named = [sum(parse_head(cell).role is not None for cell in cells) for cells in (heads, first)]
    fits = len(heads) == len(first) and not all(map(_is_number, heads))
    values = all(map(_is_number, first)) or (
        named[1] == 0 and sum("." in cell and _is_number(cell) for cell in first) > 1
    )
    if not values and not (fits and named[0] > named[1]):
        return lines
    if fits:
        return {min(lines) - 1: comment, **lines}
    fault = f"line {min(lines)} holds numbers; expected the names of the columns above them"
    raise DataError(f"{source}: {fault}")


def _is_number(cell: str) -> bool:
    return (
        re.fullmatch(r"\s*(?:[-+]?[\d.,]+(?:[eE][-+]?\d+)?|nan)?\s*", cell, re.IGNORECASE)
        is not None
    )


def _without_comments(lines: Lines, delimiter: str, source: str, notes: list[str]) -> Lines:
    """The lines without comments below the heads.

    A line that begins like a comment and has as many cells as there are heads is a row, as stations
    may be called #1; it is refused where it may be a row that somebody took out.
    """
    heads, *below = lines
    marked = [n for n in below if lines[n].lstrip().startswith(COMMENTS)]
    if not marked:
        return lines
    # Between spaces a mark may be a cell
    texts = [text for n in marked for text in (lines[n], lines[n].lstrip(" #%/"))]
    if len(_cells(lines[heads], delimiter)) not in {len(_cells(text, delimiter)) for text in texts}:
        notes.append(f"{len(marked)} comments below the heads, the first in line {marked[0]}")
        return {n: line for n, line in lines.items() if n not in set(marked)}
    first = {n: _cells(line, delimiter)[0].strip() for n, line in lines.items()}
    plain = [first[n] for n in below if n not in set(marked)]
    taken, numbers = {*first.values(), ""}, bool(plain) and all(map(_is_number, plain))
    for n in marked:
        name = first[n].lstrip("".join(COMMENTS))
        if name.lstrip() != name or name in taken or (numbers and _is_number(name)):
            begin = (first[n] or lines[n].strip())[:20]
            fault = f"begins with {begin!r}: a row, or a comment?"
            raise DataError(f"{source}, line {n}: {fault} quote the cell or take the line out")
    like_it = f"{first[marked[0]]!r} or the like, the first in line {marked[0]}"
    notes.append(f"{len(marked)} rows begin with {like_it}")
    return lines


def _rectangular(lines: Lines, delimiter: str, source: str) -> list[list[str]]:
    """All cells; quotes that stay open, and lines with more or fewer cells than heads,
    are refused.
    """
    for n, line in lines.items():
        if line.count('"') % 2:
            raise DataError(
                f"{source}, line {n}: a quotation mark is not closed; close it, or double it"
            )
    cells = [_cells(line, delimiter) for line in lines.values()]
    count, *counts = map(len, cells)
    if counts and len(set(counts)) == 1 and counts[0] != count:
        hint = (
            ("; decimal commas need semicolons or tabs between columns") if delimiter == "," else ""
        )
        longer = cells[1:] if counts[0] > count else cells[:1]
        if abs(counts[0] - count) == 1 and not any(row[-1].strip() for row in longer):
            hint = ", the last of them empty: end heads and rows alike"
        fault = f"{count} heads, but every line below has {counts[0]} cells{hint}"
        raise DataError(f"{source}, line {min(lines)}: {fault}")
    problems, below = Problems(source), list(lines)[1:]
    for n, row in zip(below, cells[1:], strict=True):
        if len(row) != count and sum(parse_head(cell).role is not None for cell in row) > 1:
            fault = f"heads of another table than that of line {min(lines)}"
            raise DataError(f"{source}, line {n}: {fault}: write each into a file of its own")
    names = (
        f"line {n} ({width} cells)"
        for n, width in zip(below, counts, strict=True)
        if width != count
    )
    mark = DELIMITERS.get(delimiter, delimiter)
    problems.add_rows(source, names, f"expected {count} cells between {mark}, as there are heads")
    problems.raise_if_any()
    return cells


def _decimal(text: str, frame: pd.DataFrame, delimiter: str, notes: list[str]) -> str:
    """The mark that most numbers have that have one; a comma is noted.

    Between commas it can be one in quoted cells alone; where all cells with a comma may be marked
    between thousands, the note asks.
    """
    if delimiter == "," and '"' not in text:
        return "."
    cells = pd.concat([frame[i] for i in frame.columns])
    marked = cells[cells.str.fullmatch(DECIMAL_COMMA)]
    thousands = bool(marked.str.fullmatch(THOUSANDS).all())
    some = pd.concat([frame[i].iloc[:: max(1, len(frame) // LOOKED_AT)] for i in frame.columns])
    commas, points = (some.str.fullmatch(mark).sum() for mark in (DECIMAL_COMMA, DECIMAL_POINT))
    if (delimiter == "," and thousands) or commas <= points:
        return "."
    first = marked.iloc[0].strip()
    hint = (
        f": {first} is {first.replace(',', '.')}; if commas stand between thousands, take them out"
    )
    notes.append("decimal commas" + hint * thousands)
    return ","
