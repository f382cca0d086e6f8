"""From files of tables (text, Parquet, records) to `Sheet`: values that lie within one another, and
cells that hold several numbers, lists, complex ones or places, as columns of their own.
"""

from __future__ import annotations

import ast
import codecs
import json
import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from gsparc.base.errors import DataError, Problems, absent, list_first, readable
from gsparc.base.files import check_content, check_depth, refuse_git_pointer, refuse_repeated
from gsparc.base.limits import MOST_VALUES, most_text_bytes
from gsparc.tables import is_table
from gsparc.tables.arrays import ARRAY_SUFFIXES
from gsparc.tables.heads import AXIS_WORDS, LISTS, SHEET, parse_head, words_of
from gsparc.tables.sheet import Sheet
from gsparc.tables.text import check_bytes, read_text

POINTS = {"trkpt", "wpt", "Placemark"}  # of GPX and KML
# As GeoJSON and KML order coordinates
DEGREES, METRES = ["longitude", "latitude", "height"], ["x", "y", "z"]
# Of cells with a place: whether latitudes come first;
# over how many degrees places that are none reach.
PLACED = {"coordinates": (False, 360), "point": (False, 3), "pair": (True, 3)}


def read_records(path: Path) -> pd.DataFrame:
    """Return a row for each record, or for each of the records in a list within it.

    A column is called by the last part of its path, where no other one is, else by all of it.

    Raises:
        ValueError, ElementTree.ParseError: no JSON, or no XML.
    """
    text = path.read_text(encoding="utf-8-sig")
    check_content(path, text, "[{<\n")
    check_depth(path, text)
    frame = pd.json_normalize(_of_xml(text) if text.lstrip().startswith("<") else _of_json(text))
    while (
        name := next((name for name in frame if frame[name].map(_holds_records).any()), None)
    ) is not None:
        frame = frame.explode(name, ignore_index=True)
        inner = pd.json_normalize(
            [record if isinstance(record, dict) else {} for record in frame.pop(name)]
        )
        frame = frame.join(inner.add_prefix(f"{name}."))
    frame = unfold_places(frame)
    lengths = frame.map(lambda value: len(value) if isinstance(value, list) else 0).max()
    for name in lengths.index[lengths > MOST_VALUES]:
        raise ValueError(
            f"more than {MOST_VALUES:,} values in {name!r} of one record; expected one in each"
        )
    short = Counter(name.rpartition(".")[2] for name in frame)
    return frame.rename(
        columns=lambda name: last if short[last := name.rpartition(".")[2]] == 1 else name
    )


def unfold_places(frame: pd.DataFrame) -> pd.DataFrame:
    """Return lists of coordinates, in columns called as in `PLACED`, as a column for each."""
    for name in [name for name in frame if name.rpartition(".")[2] in PLACED]:
        before, dot, how = name.rpartition(".")
        padded = [
            ([*values] if isinstance(values, list) else []) + 3 * [None]
            for values in frame.pop(name)
        ]
        places = pd.DataFrame([values[:3] for values in padded]).apply(
            pd.to_numeric, errors="coerce"
        )
        (turned, most), across = PLACED[how], places[[0, 1]]
        degrees = (across.abs().max() <= 360).all() and (
            np.ptp(across.dropna(), axis=0) < most
        ).all()
        heads = DEGREES if degrees else METRES
        heads = [heads[1], heads[0], heads[2]] if degrees and turned else heads
        places.columns = [before + dot + head for head in heads]
        frame = frame.join(places.loc[:, places.notna().any()])
    return frame


def _holds_records(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(entry, dict) for entry in value)


def _of_json(text: str) -> list[dict[str, Any]]:
    try:
        content = json.loads(text, object_pairs_hook=refuse_repeated)
    except json.JSONDecodeError as whole:  # a record a line
        if "\n" not in text.strip():
            raise
        content = [_of_line(line, n) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
        if len(content) < 2 or not all(isinstance(record, dict) for record in content):
            raise whole from None
    if isinstance(content, dict):
        lists = [value for value in content.values() if _holds_records(value)]
        content = lists[0] if len(lists) == 1 else _of_columns(content) or [content]
    if not _holds_records(content):
        raise ValueError("no records: expected [{...}, ...], or one {...} a line")
    return [
        record if isinstance(record, dict) else {} for record in content
    ]  # rows keep their numbers


def _of_line(line: str, number: int) -> Any:
    try:
        return json.loads(line, object_pairs_hook=refuse_repeated)
    except json.JSONDecodeError as fault:
        raise ValueError(
            f"line {number}, column {fault.colno}: {fault.msg}; is it cut off?"
        ) from None


def _of_columns(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Records of what pandas writes but lists of records; else none.

    {column: {row: value}}, {row: {column: value}}, {column: [value]},
    or columns beside rows of data.
    """
    values = [*content.values()]
    if {"data", "columns"} <= content.keys():
        frame = pd.DataFrame(content["data"], columns=content["columns"])
    elif {*map(type, values)} == {dict} and len({*map(tuple, values)}) == 1:
        by_row = all(map(str.isdigit, content))
        frame = pd.DataFrame.from_dict(content, orient="index" if by_row else "columns")
    elif {*map(type, values)} == {list} and len({*map(len, values)}) == 1:
        frame = pd.DataFrame(content)
    else:
        return []
    return frame.to_dict("records") if len(frame) > 1 and frame.shape[1] > 1 else []


def _of_xml(text: str) -> list[dict[str, Any]]:
    points = [element for element in ElementTree.fromstring(text).iter() if _tag(element) in POINTS]
    if not points:
        raise ValueError("no points of GPX or KML")
    records = []
    for point in points:
        record: dict[str, Any] = dict(point.attrib)
        for element in point.iter():
            value = next((child.text for child in element if _tag(child) == "value"), element.text)
            name = element.get("name", _tag(element))
            if name == "coordinates" and element.text:
                record[name] = np.fromstring(element.text, sep=",").tolist()
            elif value and value.strip() and name != "value":
                record[name] = value.strip()
        records.append(record)
    return records


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


LIST = re.compile(r"\s*\[(.+)\]\s*", re.DOTALL)
PLACES = LISTS["place"] | LISTS["vector"] | set(AXIS_WORDS)
# Begins the rows of an ESP32, whose lists hold imaginary parts before real ones
LOGGED = "CSI_DATA"
NUMBER = r"[-+]?\d*\.?\d+(?:e[-+]?\d+)?"
PAIR = re.compile(rf"(?i)[\[(]?\s*({NUMBER}(?:(?:\s*[,;]\s*|\s+){NUMBER}){{1,2}})\s*[\])]?")
POINT = re.compile(
    rf"(?i)(?:SRID=\d+;)?\s*POINT\s*Z?M?\s*(?:\(\s*({NUMBER}(?:\s+{NUMBER})+)\s*\)|EMPTY)"
)
HALF = re.compile(r"(?i)(\d+(?:\.\d+)?)\s*°?\s*([nsew])\b")  # 51.49 N
FINE = re.compile(r"\.\d{4}")  # digits of degrees that tell streets apart


def unfold_cells(sheet: Sheet) -> Sheet:
    """Return lists of one length as NAME_1, ..., complex numbers as csi_re_1, ..., and named ones;
    noted.
    """
    logged = bool((sheet.frame.iloc[:, :1] == LOGGED).all(axis=None))
    parts: list[pd.DataFrame] = []
    unfolded: list[str] = []
    for head in sheet.heads:
        if (table := _records(sheet, head)) is not None:
            parts.append(table)
            unfolded.append(f"{head} ({', '.join(table)})")
            continue
        rows = [_numbers(cell) for cell in sheet.frame[head].iloc[:1]]
        rows += (
            [_numbers(cell) for cell in sheet.frame[head].iloc[1:]] if rows[0] is not None else []
        )
        if len({-1 if row is None else len(row) for row in rows}) > 1 or rows[0] is None:
            parts.append(sheet.frame[[head]])
            continue
        values, number = np.array(rows), re.search(r"(\d+)\W*$", head)
        tones = (
            [int(number[1])]
            if number and values.shape[1] == 1
            else [*range(1, values.shape[1] + 1)]
        )
        if logged:
            values = values[:, 1::2] + 1j * values[:, ::2].real
            tones = (
                np.fft.fftfreq(values.shape[1], 1 / values.shape[1]).round().astype(int).tolist()
            )
        named = (
            {"csi_re": values.real, "csi_im": values.imag}
            if values.imag.any()
            else {head: values.real}
        )
        parts += [
            pd.DataFrame(v, columns=[f"{name}_{tone}" for tone in tones])
            for name, v in named.items()
        ]
        unfolded.append(head)
    frame = pd.concat(parts, axis=1) if unfolded else sheet.frame
    if not unfolded or frame.columns.has_duplicates:
        return sheet
    sheet.notes.append(f"a column for each number of a cell: {list_first(unfolded, 3)}")
    return replace(sheet, frame=frame)


def _records(sheet: Sheet, head: str) -> pd.DataFrame | None:
    """Columns of what a column's cells hold by names or as places;
    None where one of them holds neither.
    """
    named = bool(PLACES & {*words_of(head)}) and parse_head(head).role is None
    texts = (cell.strip() for cell in sheet.frame[head] if isinstance(cell, str))
    first = next((text for text in texts if text.lower() not in SHEET["missing"]), "")
    if _record(first, named) is None:  # before all cells of wide tables are looked at
        return None
    read = [_record(cell, named) if cell else {} for cell in sheet.words(head)]
    if None in read:
        return None
    frame = unfold_places(pd.json_normalize([{head: record} for record in read]))
    short = {name: name.removeprefix(f"{head}.") for name in frame}
    plain = [
        n for n, bare in short.items() if parse_head(n).role is None and bare not in sheet.heads
    ]
    return None if frame.empty else frame.rename(columns={name: short[name] for name in plain})


def _record(cell: str, named: bool) -> dict[str, Any] | None:
    """What one cell holds by name, places under one of `PLACED`;
    None where it is neither.
    """
    if cell.startswith("{"):
        for read in (json.loads, ast.literal_eval):
            with suppress(ValueError, SyntaxError, RecursionError, MemoryError):
                return dict(read(cell))
    if point := POINT.fullmatch(cell):
        return {"point": [float(number) for number in (point[1] or "").split()]}
    halves = {half.lower(): float(number) for number, half in HALF.findall(cell)}
    if len(halves) == 2 and not HALF.sub("", cell).strip(" ,;"):
        axes = (
            halves.get("n", -halves.get("s", np.nan)),
            halves.get("e", -halves.get("w", np.nan)),
        )
        return {"pair": [*axes]} if np.isfinite(axes).all() else None
    pair = PAIR.fullmatch(cell)
    numbers = re.split(r"[,;\s]+", pair[1]) if pair else []
    fine = named or (numbers and all(FINE.search(number) for number in numbers))
    return {"pair": [float(number) for number in numbers]} if fine and numbers else None


def _numbers(cell: Any) -> np.ndarray | None:
    """What a cell holds (n,) complex; None where it is neither a list nor complex."""
    if isinstance(cell, str):
        inside = LIST.fullmatch(cell)
        cell = re.split(r"[,;\s]+", inside[1].strip()) if inside else [cell]
        if not inside and not re.search(r"\d\s*\*?[ij]\s*\)?\s*$", cell[0]):
            return None
        cell = [re.sub(r"[()*\s]", "", text).replace("i", "j") for text in cell]
    if not isinstance(cell, list | np.ndarray) or not len(cell):
        return None
    try:
        return np.array([complex(text) for text in cell])
    except (TypeError, ValueError):
        return None


def read_frame(path: Path, kind: str) -> Sheet:
    """Read the columns of a file of one of `FRAMES`.

    Raises:
        DataError: pyarrow is missing, or the file is damaged or empty.
    """
    source = str(path)
    if kind != RECORDS and find_spec("pyarrow") is None:
        raise DataError(f"{source}: {kind} needs pyarrow; say: pip install 'gsparc[tables]'")
    # Pyarrow and pandas raise anything
    with readable(source, f"damaged or not a {kind} file", Exception):
        frame = FRAMES[kind](path)
    unnamed = [i for i, name in enumerate(frame.index.names) if name is None]
    frame = frame.reset_index(level=unnamed, drop=True) if unnamed else frame
    # Pandas sets some columns aside as an index: columns all the same
    if frame.index.names[0] is not None:
        frame = frame.reset_index(allow_duplicates=True)
    frame.columns = frame.columns.astype(str)
    for name in frame.columns[frame.columns.duplicated()]:
        raise DataError(f"{source}: two columns are named {name!r}; rename one")
    if frame.empty:
        raise DataError(f"{source}: no rows")
    return Sheet(source, frame, tuple(f"row {i}" for i in range(len(frame))))


RECORDS = "JSON, GPX or KML"
FRAMES: dict[str, Callable[[Path], pd.DataFrame]] = {
    "Parquet": pd.read_parquet,
    "Feather": pd.read_feather,
    RECORDS: read_records,
}
STARTS = {b"PAR1": "Parquet", b"ARRO": "Feather", **dict.fromkeys((b"{", b"[{", b"<"), RECORDS)}
PEEKED = 64  # bytes that tell what a file is


def read_sheet(path: str | Path, problems: Problems | None = None) -> Sheet:
    """Read the cells of a table, a column for each number of one,
    with notes on what was recognised.

    Args:
        path: of the table.
        problems: of another table, which take what is wrong with this one, too.

    Raises:
        DataError: no such file, another ending, or no table.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(
            f"{absent(path)}; expected a table, or arrays (*{', *'.join(ARRAY_SUFFIXES)})"
        )
    if not is_table(path):
        raise DataError(f"{path}: expected a table (csv, parquet, json, ...), no arrays")
    refuse_git_pointer(path)
    with path.open("rb") as file:
        first = b"".join(file.read(PEEKED).removeprefix(codecs.BOM_UTF8).split())
    kind = next((kind for start, kind in STARTS.items() if first.startswith(start)), None)
    kind = "Parquet" if path.suffix.lower() == ".parquet" else kind
    if kind == RECORDS:
        check_bytes(path, path.stat().st_size, most_text_bytes())
    sheet = unfold_cells(read_text(path) if kind is None else read_frame(path, kind))
    return replace(sheet, problems=Problems(path) if problems is None else problems)
