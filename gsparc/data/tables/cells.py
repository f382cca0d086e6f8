"""Cells that hold several numbers, lists and complex ones, as a column for each."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from gsparc.data.errors import list_first
from gsparc.data.tables.sheet import Sheet

LIST = re.compile(r"\s*\[(.+)\]\s*", re.DOTALL)
LOGGED = "CSI_DATA"  # begins the rows of an ESP32, whose lists hold imaginary parts before real ones


def unfold_cells(sheet: Sheet) -> tuple[Sheet, list[str]]:
    """Return lists of one length as NAME_1, ..., complex numbers as csi_re_1, csi_im_1, ..., and a note."""
    logged = bool((sheet.frame.iloc[:, :1] == LOGGED).all(axis=None))
    parts: list[pd.DataFrame] = []
    unfolded: list[str] = []
    for head in sheet.heads:
        rows = [_numbers(cell) for cell in sheet.frame[head].iloc[:1]]
        rows += [_numbers(cell) for cell in sheet.frame[head].iloc[1:]] if rows[0] is not None else []
        if len({-1 if row is None else len(row) for row in rows}) > 1 or rows[0] is None:
            parts.append(sheet.frame[[head]])
            continue
        values, number = np.array(rows), re.search(r"(\d+)\W*$", head)
        tones = [int(number[1])] if number and values.shape[1] == 1 else [*range(1, values.shape[1] + 1)]
        if logged:
            values = values[:, 1::2] + 1j * values[:, ::2].real
            tones = np.fft.fftfreq(values.shape[1], 1 / values.shape[1]).round().astype(int).tolist()
        held = {"csi_re": values.real, "csi_im": values.imag} if values.imag.any() else {head: values.real}
        parts += [pd.DataFrame(v, columns=[f"{name}_{tone}" for tone in tones]) for name, v in held.items()]
        unfolded.append(head)
    frame = pd.concat(parts, axis=1) if unfolded else sheet.frame
    if not unfolded or frame.columns.has_duplicates:
        return sheet, []
    return replace(sheet, frame=frame), [f"a column for each number of a cell: {list_first(unfolded, 3)}"]


def _numbers(cell: Any) -> np.ndarray | None:
    """What a cell holds (n,) complex; None where it is neither a list nor complex."""
    if isinstance(cell, str):
        inside = LIST.fullmatch(cell)
        cell = re.split(r"[,;\s]+", inside[1].strip()) if inside else [cell]
        if not inside and not re.search(r"\d\s*\*?[ij]\s*\)?\s*$", cell[0]):
            return None
        cell = [re.sub(r"[()*\s]", "", one).replace("i", "j") for one in cell]
    if not isinstance(cell, list | np.ndarray) or not len(cell):
        return None
    try:
        return np.array([complex(one) for one in cell])
    except (TypeError, ValueError):
        return None
