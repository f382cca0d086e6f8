"""A second table that lists the stations: name, place, and what differs between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsparc.data.errors import Problems
from gsparc.data.tables.columns import as_station, choose
from gsparc.data.tables.places import Places, places
from gsparc.data.tables.sheet import Sheet

PER_STATION = ("sensitivity_db", "carrier_hz")


@dataclass(frozen=True)
class StationList:
    """Stations in the order of their file.

    Attributes:
        names: (T,).
        places: (T,).
        extra: (T,) arrays by name: `sensitivity_db`, `carrier_hz`.
    """

    names: tuple[str, ...]
    places: Places
    extra: dict[str, np.ndarray]


def read_stations(sheet: Sheet, problems: Problems) -> tuple[StationList | None, list[str]]:
    """The stations of a table: name, and x, y, z or latitude, longitude, height, empty where nobody knows."""
    called = [head for head in sheet.heads if head.strip().lower() in ("name", "id")]
    chosen, notes = choose(sheet, {"station": called[0]} if len(called) == 1 else {}, problems)
    chosen = {columns[0].role: columns for columns in (tuple(map(as_station, c)) for c in chosen.values())}
    notes = [f"{sheet.source}: {note}" for note in notes if not note.startswith("not used")]
    if "station" not in chosen:
        return problems.add(sheet.source, "no column of names; expected one called name or station"), notes
    found = places(sheet, chosen, "station_", problems, unknown=True)
    if found is None:
        if not problems:
            problems.add(
                sheet.source, "no coordinates; expected columns x, y, z or latitude, longitude, height"
            )
        return None, notes
    names = sheet.words(chosen["station"][0].head or "")
    for i in np.flatnonzero(names == ""):
        problems.add(f"{sheet.source}, {sheet.rows[i]}", "no name; expected the station's")
    values, counts = np.unique(names, return_counts=True)
    for name in values[(counts > 1) & (values != "")]:
        rows = " and ".join(sheet.rows[i] for i in np.flatnonzero(names == name)[:2])
        problems.add(sheet.source, f"station {str(name)!r} is listed twice, in {rows}")
    extra = {}
    for role in PER_STATION:
        array = chosen[role][0].numbers(sheet, problems) if role in chosen else None
        if array is not None:
            extra[role] = array
    return StationList(tuple(map(str, names)), found, extra), notes
