"""What columns that are not used say of levels, in sentences with the setting that uses them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsparc.data.checks.column_effects import LEAST_ROWS, LevelsAtPlaces, find_effects, find_filled
from gsparc.data.checks.plausibility import find_marks
from gsparc.data.errors import Caution
from gsparc.data.links.georeference import Georeference
from gsparc.data.tables.columns import Chosen, say_column, used_heads
from gsparc.data.tables.sheet import Sheet


def say_effects(sheet: Sheet, chosen: Chosen, arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Return a caution for each column that explains what places and stations do not, and how to use it.

    Args:
        sheet: the table.
        chosen: its columns that are used.
        arrays: that they became.
    """
    place = _places(arrays, len(sheet))
    if "rssi_db" not in arrays or place is None:
        return []
    level = arrays["rssi_db"].reshape(len(sheet), -1)
    row, column = np.nonzero(np.isfinite(level) & ~np.isin(level, find_marks(level.ravel())))
    own = arrays.get("station", np.zeros(len(sheet), np.int64))
    station = own[row] if level.shape[1] == 1 else column
    copies = sheet.frame.astype(str).duplicated().to_numpy()[row]
    row, column, station = row[~copies], column[~copies], station[~copies]
    used = used_heads(chosen)
    links = LevelsAtPlaces(place[row], station, level[row, column])
    words = {head: sheet.words(head) for head in sheet.heads if head not in used}
    names = [column.head or "" for column in chosen.get("station", ())]
    devices = list[str]()
    power, notes, wide = chosen["rssi_db"][0], list[str](), level.shape[1] > 1
    times = f"*{power.unit.times}" if power.unit is not None and power.unit.times else ""
    power_text = f"{power.head}{times}"
    if words and len(links) < LEAST_ROWS:
        few = f"columns that are not used are asked what they say of levels from {LEAST_ROWS} links on"
        return [f"{few}, here are {len(links)}: devices, powers or other transmitters would pass unseen"]
    for head, value in find_filled(links, row, words).items():
        other = next(word for word in words[head][row] if word != value)
        said = f"column {head!r}: levels of rows where it is {value!r} follow their neighbours, without noise"
        how = f"{say_column('run', head)} 'dataset.runs=[\"{other}\"]' leaves them out"
        notes.append(Caution(f"{said}: filled in, not measured? {how}"))
    for effect in find_effects(links, row, words):
        head = effect.head
        said = (
            f"column {head!r} is not used and explains {effect.share:.0%} of what places and stations leave"
        )
        if effect.kind == "number":
            factor = f"*{abs(effect.size):g}" * (abs(effect.size) != 1)
            power_text += f"{'+' if effect.size < 0 else '-'}{head}{factor}"
            how = f"{say_column('rssi_db', power_text)} takes it off"
            what = f"a number that adds {effect.size:g} dB each to the level"
        elif effect.kind == "device":
            devices.append(head)
            how = f"{say_column('device', '+'.join(devices))} takes each off"
            what = f"an offset of all levels for each value, up to {effect.size:.1f} dB: devices"
            what += ", or floors" * all(word.lstrip("-").isdigit() for word in set(words[head]))
            if "floors" in what and not {"z", "rx_z", "tx_z"} & set(chosen):
                how += f"; of floors {say_column('z', f'{head}*3.2')} takes 3.2 m each"
        else:
            names.append(head)
            how = f"{say_column('station', '+'.join(names))} tells them apart"
            what = "another transmitter for each value"
            how = "a file for each value takes them apart" if wide else how
        notes.append(Caution(f"{said}: {what}? {how}"))
    return notes


def _places(arrays: Mapping[str, np.ndarray], rows: int) -> np.ndarray | None:
    """Places (S, d) [m] of what moves; None where nothing does."""
    if "latitude" in arrays:
        degrees = arrays["latitude"], arrays["longitude"]
        parts = [Georeference.from_coordinates(*degrees).from_degrees(*degrees)]
    else:
        parts = [a for name, a in arrays.items() if name in ("rx_position", "tx_position") and a.ndim == 2]
    parts += [
        arrays[f"{end}_height"][:, None]
        for end in ("rx", "tx")
        if np.ndim(arrays.get(f"{end}_height", 0)) == 1
    ]
    place = np.column_stack(parts) if parts else np.zeros((0, 1))
    return place if len(place) == rows and np.isfinite(place).all() and np.ptp(place, axis=0).any() else None
