"""Records of JSON, GPX and KML, whose values lie within one another, as rows and columns."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

POINTS = {"trkpt", "wpt", "Placemark"}  # of GPX and KML
PLACE = ("longitude", "latitude", "height")  # as GeoJSON and KML order coordinates


def read_records(path: Path) -> pd.DataFrame:
    """Return a row for each record, or for each of the records in a list within it.

    A column is called by the last part of its path, where no other one is, else by all of it.

    Raises:
        ValueError, ElementTree.ParseError: no JSON, or no XML.
    """
    text = path.read_text(encoding="utf-8-sig")
    frame = pd.json_normalize(_of_xml(text) if text.lstrip().startswith("<") else _of_json(text))
    while (name := next((name for name in frame if frame[name].map(_holds_records).any()), None)) is not None:
        frame = frame.explode(name, ignore_index=True)
        inner = pd.json_normalize([one if isinstance(one, dict) else {} for one in frame.pop(name)])
        frame = frame.join(inner.add_prefix(f"{name}."))
    for name in [name for name in frame if name.rpartition(".")[2] == "coordinates"]:
        places = pd.DataFrame([one if isinstance(one, list) else [] for one in frame.pop(name)])
        frame = frame.join(places.rename(columns=dict(enumerate(PLACE))).loc[:, lambda p: p.notna().any()])
    short = Counter(name.rpartition(".")[2] for name in frame)
    return frame.rename(columns=lambda name: last if short[last := name.rpartition(".")[2]] == 1 else name)


def _holds_records(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(one, dict) for one in value)


def _of_json(text: str) -> list[dict[str, Any]]:
    try:
        content = json.loads(text)
    except json.JSONDecodeError:  # a record a line
        content = [json.loads(line) for line in text.splitlines() if line.strip()]
    if isinstance(content, dict):
        held = [value for value in content.values() if _holds_records(value)]
        content = held[0] if len(held) == 1 else [content]
    if not _holds_records(content):
        raise ValueError("no records: expected [{...}, ...], or one {...} a line")
    return [one for one in content if isinstance(one, dict)]


def _of_xml(text: str) -> list[dict[str, Any]]:
    points = [one for one in ElementTree.fromstring(text).iter() if _tag(one) in POINTS]
    if not points:
        raise ValueError("no points of GPX or KML")
    records = []
    for point in points:
        record: dict[str, Any] = dict(point.attrib)
        for one in point.iter():
            held = next((child.text for child in one if _tag(child) == "value"), one.text)
            name = one.get("name", _tag(one))
            if name == "coordinates" and one.text:
                record[name] = np.fromstring(one.text, sep=",").tolist()
            elif held and held.strip() and name != "value":
                record[name] = held.strip()
        records.append(record)
    return records


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]
