"""Slots of scanners and phones, `Serving PCI, Serving RSRP, N1 PCI, N1 RSRP, ...`, as a row for each."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

import pandas as pd

from gsparc.data.errors import list_first
from gsparc.data.tables.heads import meaning_by_word, unit_of, words_of
from gsparc.data.tables.sheet import Sheet

HOLDS = meaning_by_word("slots")
NEEDED, LEAST = {"PCI", "RSRP"}, 2  # of a slot; slots


def find_slots(heads: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return heads of each slot by what they hold, by the slot's name; empty where there are not several."""
    found: dict[str, dict[str, str]] = {}
    for head in heads:
        words = words_of(unit_of(head)[0])
        held = [HOLDS[word] for word in words if word in HOLDS]
        name = " ".join(word for word in words if word not in HOLDS)
        if len(held) == 1 and held[0] not in found.setdefault(name, {}):
            found[name][held[0]] = head
    slots = {name: parts for name, parts in found.items() if set(parts) >= NEEDED}
    return slots if len(slots) >= LEAST else {}


def unfold_slots(sheet: Sheet, said: Container[str]) -> tuple[Sheet, list[str]]:
    """Return a row per slot with a cell and its level, rows of one moment together, and a note.

    Args:
        sheet: the table.
        said: heads that settings name: their table is taken as it is.
    """
    slots = find_slots(sheet.heads)
    used = [head for parts in slots.values() for head in parts.values()]
    if not slots or any(head in said for head in used):
        return sheet, []
    # A channel that only one slot has is the moment's.
    shared = next((parts["EARFCN"] for parts in slots.values() if "EARFCN" in parts), None)
    level = next(iter(slots.values()))["RSRP"]
    names = {"PCI": "PCI", "RSRP": f"RSRP{level[len(unit_of(level)[0]) :]}", "EARFCN": "EARFCN"}
    kept, parts = [head for head in sheet.heads if head not in used], []
    for slot in slots.values():
        held = (sheet.words(slot["PCI"]) != "") & (sheet.words(slot["RSRP"]) != "")
        of_slot = {head: name for part, name in names.items() if (head := slot.get(part, shared)) is not None}
        parts.append(sheet.frame.loc[held, [*kept, *of_slot]].rename(columns=of_slot))
    whole = pd.concat(parts).sort_index(kind="stable")
    rows = tuple(sheet.rows[i] for i in whole.index)
    result = replace(sheet, frame=whole.reset_index(drop=True), rows=rows)
    return result, [f"slots {list_first([*map(repr, slots)], 3)}: {len(rows)} rows of {len(sheet)} moments"]
