"""Records of JSON, GPX and KML, whose values lie within one another, as rows and columns."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from gsparc.base.files import check_content, check_depth, refuse_repeated
from gsparc.base.limits import MOST_VALUES

POINTS = {"trkpt", "wpt", "Placemark"}  # of GPX and KML
# As GeoJSON and KML order coordinates
DEGREES, METRES = ["longitude", "latitude", "height"], ["x", "y", "z"]
# Of cells with a place: whether latitudes come first;
# over how many degrees places that are none reach.
PLACES = {"coordinates": (False, 360), "point": (False, 3), "pair": (True, 3)}


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
    """Return lists of coordinates, in columns called as in `PLACES`, as a column for each."""
    for name in [name for name in frame if name.rpartition(".")[2] in PLACES]:
        before, dot, how = name.rpartition(".")
        padded = [
            ([*values] if isinstance(values, list) else []) + 3 * [None]
            for values in frame.pop(name)
        ]
        places = pd.DataFrame([values[:3] for values in padded]).apply(
            pd.to_numeric, errors="coerce"
        )
        (turned, most), across = PLACES[how], places[[0, 1]]
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
