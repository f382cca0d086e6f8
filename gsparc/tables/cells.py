"""Cells that hold several numbers, lists, complex ones and places, as a column for each."""

from __future__ import annotations

import ast
import json
import re
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from gsparc.base.errors import list_first
from gsparc.tables.heads import AXIS_WORDS, LISTS, SHEET, parse_head, words_of
from gsparc.tables.records import unfold_places
from gsparc.tables.sheet import Sheet

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
    """What one cell holds by name, places under one of `records.PLACES`;
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
