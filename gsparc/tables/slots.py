"""Slots of scanners, `Serving PCI, Serving RSRP, N1 PCI, N1 RSRP, ...`, as rows;
rows of tones as columns.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

import pandas as pd

from gsparc.base.errors import list_first
from gsparc.tables.heads import KINDS, LISTS, meaning_by_word, parse_head, unit_of, words_of
from gsparc.tables.sheet import Sheet

HOLDS = meaning_by_word("slots")
NEEDED, LEAST = {"PCI", "RSRP"}, 2  # of a slot; slots


def find_slots(heads: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return heads of each slot by what they hold, by the slot's name;
    empty where there are not several.
    """
    parts_of: dict[str, dict[str, str]] = {}
    for head in heads:
        words = words_of(unit_of(head)[0])
        kinds = [HOLDS[word] for word in words if word in HOLDS]
        name = " ".join(word for word in words if word not in {*HOLDS, "cell", "dbm"})
        if len(kinds) == 1 and kinds[0] not in parts_of.setdefault(name, {}):
            parts_of[name][kinds[0]] = head
    slots = {name: parts for name, parts in parts_of.items() if set(parts) >= NEEDED}
    return slots if len(slots) >= LEAST else {}


def unfold_slots(sheet: Sheet, said: Container[str]) -> Sheet:
    """Return a row per slot with a cell and its level, rows of one moment together; noted.

    Args:
        sheet: the table.
        said: heads that settings name: their table is taken as it is.
    """
    slots = find_slots(sheet.heads)
    used = [head for parts in slots.values() for head in parts.values()]
    if not slots or any(head in said for head in used):
        return sheet
    # A channel that only one slot has is the moment's.
    shared = next((parts["EARFCN"] for parts in slots.values() if "EARFCN" in parts), None)
    level = next(iter(slots.values()))["RSRP"]
    names = {"PCI": "PCI", "RSRP": f"RSRP{level[len(unit_of(level)[0]) :]}", "EARFCN": "EARFCN"}
    # What else is of one slot says nothing of the others.
    slot_words = [{*name.split()} for name in slots if name]
    rest = [head for head in sheet.heads if head not in used]
    common = [
        h for h in rest if h in said or not any(words <= {*words_of(h)} for words in slot_words)
    ]
    parts = []
    for slot in slots.values():
        has_cell = (sheet.words(slot["PCI"]) != "") & (sheet.words(slot["RSRP"]) != "")
        of_slot = {
            head: name
            for part, name in names.items()
            if (head := slot.get(part, shared)) is not None
        }
        parts.append(sheet.frame.loc[has_cell, [*common, *of_slot]].rename(columns=of_slot))
    whole = pd.concat(parts).sort_index(kind="stable")
    rows = tuple(sheet.rows[i] for i in whole.index)
    named = list_first([*map(repr, slots)], 3)
    sheet.notes.append(f"slots {named}: {len(rows)} rows of {len(sheet)} moments")
    return replace(sheet, frame=whole.reset_index(drop=True), rows=rows)


def unfold_tones(sheet: Sheet) -> Sheet:
    """Return one row, with columns of all tones, for rows of one place that are of a tone each;
    noted.
    """
    roles = {head: parse_head(head) for head in sheet.heads}
    parts = {head: read.role for head, read in roles.items() if str(read.role).startswith("csi_")}
    if len(parts) != 2 or any(roles[head].label for head in parts):
        return sheet
    tones = [head for head in sheet.heads if LISTS["tone"] & {*words_of(unit_of(head)[0])}]
    tone = next((head for head in tones if sheet.frame[head].nunique() > 1), None)
    rest = [head for head in sheet.heads if head not in {*parts, *tones}]
    placed = [h for h in rest if KINDS.get(str(roles[h].role)) in ("length", "angle", "text")]
    values = None if tone is None or not placed else sheet.numbers(tone, roles[tone].unit)
    if values is None or not (values.round() == values).all():
        return sheet
    place = pd.factorize(sheet.joined(placed))[0]
    long = sheet.frame.assign(**{BY: place, str(tone): values.astype(int)})
    # Radios that hop have a tone for each row, and few rows at a place.
    if long.duplicated([BY, tone]).any() or 2 * len(set(place)) > len(place):
        return sheet
    wide = long.pivot(index=BY, columns=tone, values=list(parts))
    units = {head: f" [{read.unit.name}]" if read.unit else "" for head, read in roles.items()}
    wide.columns = [f"{parts[head]}_{number}{units[head]}" for head, number in wide.columns]
    first = long.drop_duplicates(BY).index
    rows = tuple(sheet.rows[i] for i in first)
    frame = sheet.frame.loc[first, rest].reset_index(drop=True).join(wide)
    sheet.notes.append(f"rows of one place are tones by {tone!r}: {len(rows)} of {len(sheet)}")
    return replace(sheet, frame=frame, rows=rows)


BY = "\0place"
