"""Slots of scanners and phones, `Serving PCI, Serving RSRP, N1 PCI, N1 RSRP, ...`, as a row for each."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

import numpy as np
import pandas as pd

from gsparc.data.errors import some
from gsparc.data.tables.heads import by_word, unit_of, words_of
from gsparc.data.tables.sheet import Sheet

HOLDS = by_word("slots")
NEEDED, LEAST = {"PCI", "RSRP"}, 2  # of a slot; slots


def slots_of(heads: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return heads of each slot by what they hold, by the slot's name; empty where there are not several."""
    found: dict[str, dict[str, str]] = {}
    for head in heads:
        words = words_of(unit_of(head)[0]) if head else []
        held = [HOLDS[word] for word in words if word in HOLDS]
        name = " ".join(word for word in words if word not in HOLDS)
        if len(held) == 1 and held[0] not in found.setdefault(name, {}):
            found[name][held[0]] = head
    slots = {name: parts for name, parts in found.items() if set(parts) >= NEEDED}
    return slots if len(slots) >= LEAST else {}


def unfolded(sheet: Sheet, said: Container[str]) -> tuple[Sheet, list[str]]:
    """Return a row per slot with a cell and its level, rows of one moment together, and a note.

    Args:
        sheet: the table.
        said: heads that settings name: their table is taken as it is.
    """
    slots = slots_of(sheet.heads)
    used = [head for parts in slots.values() for head in parts.values()]
    if not slots or any(head in said for head in used):
        return sheet, []
    columns = dict(zip(sheet.heads, sheet.columns, strict=True))
    # A channel that only one slot has is the moment's.
    channels = [parts["EARFCN"] for parts in slots.values() if "EARFCN" in parts]
    shared = channels[0] if channels else ""
    level = next(iter(slots.values()))["RSRP"]
    unit = level[len(unit_of(level)[0]) :]
    names = {"PCI": "PCI", "RSRP": f"RSRP{unit}", **({"EARFCN": "EARFCN"} if channels else {})}
    parts, rows = [], []
    for slot in slots.values():
        held = np.flatnonzero((sheet.words(slot["PCI"]) != "") & (sheet.words(slot["RSRP"]) != ""))
        heads = {part: slot.get(part, shared) if part == "EARFCN" else slot[part] for part in names}
        series_of = {names[part]: columns[head].iloc[held].to_numpy() for part, head in heads.items()}
        parts.append(pd.DataFrame(series_of))
        rows.append(held)
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    whole = pd.concat(parts, ignore_index=True).iloc[order]
    kept = [head for head in sheet.heads if head and head not in used]
    series = [columns[head].iloc[row[order]].reset_index(drop=True) for head in kept]
    series += [whole[name].reset_index(drop=True) for name in whole]
    result = replace(
        sheet, heads=(*kept, *whole.columns), columns=tuple(series),
        rows=tuple(sheet.rows[i] for i in row[order]),
    )  # fmt: skip
    return result, [f"slots {some([*map(repr, slots)], 3)}: {len(row)} rows of {len(sheet)} moments"]
