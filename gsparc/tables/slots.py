"""Slots of scanners, `Serving PCI, Serving RSRP, N1 PCI, N1 RSRP, ...`, as rows;
rows of tones as columns.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import pandas as pd

from gsparc.base.errors import list_first
from gsparc.tables.heads import (
    KINDS,
    LISTS,
    match_pattern,
    meaning_by_word,
    parse_head,
    unit_of,
    words_of,
)
from gsparc.tables.sheet import Said, Sheet

HOLDS = meaning_by_word("slots")
NEEDED, LEAST = ({"PCI", "RSRP"}, {"BSSID", "RSSI"}), 2  # of a slot, either; slots


def find_slots(heads: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Return heads of each slot by what they hold, by the slot's name;
    empty where there are not several.
    """
    parts_of: dict[str, dict[str, str]] = {}
    for head in heads:
        words = _words(head)
        kinds = [HOLDS[word] for word in words if word in HOLDS]
        name = " ".join(word for word in words if word not in {*HOLDS, "cell", "dbm"})
        if len(kinds) == 1 and kinds[0] not in parts_of.setdefault(name, {}):
            parts_of[name][kinds[0]] = head
    for needed in NEEDED:
        slots = {name: parts for name, parts in parts_of.items() if set(parts) >= needed}
        if len(slots) >= LEAST:
            of_slot = needed | {"EARFCN"}
            return {
                name: {kind: head for kind, head in parts.items() if kind in of_slot}
                for name, parts in slots.items()
            }
    return {}


def _words(head: str) -> list[str]:
    """Words of a head, numbers apart."""
    return re.findall(r"[^\W\d_]+|\d+", " ".join(words_of(unit_of(head)[0])))


def ranked_names(sheet: Sheet, numbered: Mapping[str, str]) -> str | None:
    """Return the pattern of columns of names beside columns of levels, by their numbers: a name
    that stands in several of them is a station's, and the number its rank; None without.
    """
    families: dict[str, dict[str, str]] = defaultdict(dict)
    for head in sheet.heads:
        if len(number := re.findall(r"\d+", head)) == 1 and head not in numbered.values():
            families[head.replace(number[0], "*")][number[0]] = head
    for pattern, members in families.items():
        if not {*numbered} <= {*members} or len(numbered) < LEAST:
            continue
        ranks = [{*sheet.words(members[number]).tolist()} - {""} for number in numbered]
        names = set[str]().union(*ranks)
        again = len(names) < sum(map(len, ranks)) and 2 * len(names) < len(sheet) * len(ranks)
        numbers = any(re.fullmatch(r"[-+]?\d*\.?\d*", name) for name in names)
        if again and (not numbers or {*_words(pattern)} & LISTS["station"]):
            return pattern
    return None


def _said_slots(sheet: Sheet, said: Said) -> dict[str, dict[str, str]]:
    """Slots of two patterns, of names and of levels."""
    patterns = {"BSSID": str(said.get("station", "")), "RSSI": str(said.get("rssi_db", ""))}
    slots: dict[str, dict[str, str]] = defaultdict(dict)
    for kind, pattern in patterns.items():
        for head, number in match_pattern(pattern, sheet.heads).items():
            slots[number][kind] = head
    slots = {name: parts for name, parts in slots.items() if len(parts) == len(patterns)}
    return slots if len(slots) >= LEAST else {}


def unfold_slots(sheet: Sheet, said: Said) -> tuple[Sheet, Said]:
    """Return a row per slot with a station and its level, rows of one moment together; noted.

    Args:
        sheet: the table.
        said: columns by quantity; a table whose slots these name is taken as it is, unless by
            patterns of names and of levels, which go.
    """
    slots, texts = find_slots(sheet.heads), {str(value) for value in said.values()}
    if patterns := _said_slots(sheet, said):
        slots, said = patterns, {k: v for k, v in said.items() if k not in ("station", "rssi_db")}
    used = [head for parts in slots.values() for head in parts.values()]
    if not slots or (not patterns and any(head in texts for head in used)):
        return sheet, said
    # A channel that only one slot has is the moment's.
    shared = next((parts["EARFCN"] for parts in slots.values() if "EARFCN" in parts), None)
    name, level = next(
        kinds for kinds in map(sorted, NEEDED) if {*kinds} <= {*next(iter(slots.values()))}
    )
    first = next(iter(slots.values()))[level]
    unit = first[len(unit_of(first)[0]) :]
    names = {name: name, level: f"{level}{unit}", "EARFCN": "EARFCN"}
    # What else is of one slot says nothing of the others.
    slot_words = [{*slot.split()} for slot in slots if slot]
    rest = [head for head in sheet.heads if head not in used]
    common = [
        h for h in rest if h in texts or not any(words <= {*_words(h)} for words in slot_words)
    ]
    parts = []
    for slot in slots.values():
        has_cell = (sheet.words(slot[name]) != "") & (sheet.words(slot[level]) != "")
        of_slot = {
            head: kind
            for part, kind in names.items()
            if (head := slot.get(part, shared)) is not None
        }
        parts.append(sheet.frame.loc[has_cell, [*common, *of_slot]].rename(columns=of_slot))
    whole = pd.concat(parts).sort_index(kind="stable")
    rows = tuple(sheet.rows[i] for i in whole.index)
    named = list_first([*map(repr, slots)], 3)
    sheet.notes.append(f"slots {named}: {len(rows)} rows of {len(sheet)} moments")
    return replace(sheet, frame=whole.reset_index(drop=True), rows=rows), said


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
