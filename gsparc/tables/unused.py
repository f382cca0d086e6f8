"""What columns that are not used say of levels, in sentences with the setting that uses them."""

from __future__ import annotations

import numpy as np

from gsparc.base.errors import Caution
from gsparc.data.schema import Measurements
from gsparc.tables.checks.column_effects import (
    LEAST_ROWS,
    LevelsAtPlaces,
    find_effects,
    find_filled,
)
from gsparc.tables.columns import Chosen, used_heads
from gsparc.tables.roles import say_column
from gsparc.tables.sheet import Sheet


def say_effects(
    sheet: Sheet, chosen: Chosen, data: Measurements, file_row: np.ndarray
) -> list[str]:
    """Return a caution for each column that explains what places and stations do not,
    and how to use it.

    Args:
        sheet: the table.
        chosen: its columns that are used.
        data: that they became.
        file_row: (S,) row of the table, from 0, of each row of these.
    """
    if "rssi_db" not in chosen or not np.ptp(data.moving, axis=0).any():
        return []
    links, measured = LevelsAtPlaces.of(data)
    row = file_row[measured]
    # Levels may drift
    used = used_heads(chosen) - {column.head for column in chosen.get("time_s", ())}
    words = {head: sheet.words(head) for head in sheet.heads if head not in used}
    names = [column.head or "" for column in chosen.get("station", ())]
    devices = list[str]()
    power, notes, wide = chosen["rssi_db"][0], list[str](), len(chosen["rssi_db"]) > 1
    times = f"*{power.unit.times}" if power.unit is not None and power.unit.times else ""
    power_text = f"{power.head}{times}"
    if words and len(links) < LEAST_ROWS:
        few = (
            f"columns that are not used are asked what they say of levels from {LEAST_ROWS} "
            "links on"
        )
        return [
            f"{few}, here are {len(links)}: devices, powers or other transmitters would pass unseen"
        ]
    for head, value in find_filled(links, row, words).items():
        other = next(word for word in words[head][row] if word != value)
        note = (
            f"column {head!r}: levels of rows where it is {value!r} follow their neighbours, "
            "without noise"
        )
        how = f"{say_column('run', head)} 'dataset.runs=[\"{other}\"]' leaves them out"
        notes.append(Caution(f"{note}: filled in, not measured? {how}"))
    for effect in find_effects(links, row, words):
        head = effect.head
        share = f"{effect.share:.0%} of what places and stations leave"
        if effect.kind == "number":
            factor = "" if abs(effect.size) == 1 else f"*{abs(effect.size):g}"
            power_text += f"{'+' if effect.size < 0 else '-'}{head}{factor}"
            how = f"{say_column('rssi_db', power_text)} takes it off"
            meaning = f"a number that adds {effect.size:g} dB each to the level"
        elif effect.kind == "device":
            devices.append(head)
            how = f"{say_column('device', '+'.join(devices))} takes each off"
            meaning = f"an offset of all levels for each value, up to {effect.size:.1f} dB: devices"
            if all(word.lstrip("-").isdigit() for word in set(words[head])):
                meaning += ", or floors"
                if not {"z", "rx_z", "tx_z"} & set(chosen):
                    how += f"; of floors {say_column('z', f'{head}*3.2')} takes 3.2 m each"
        else:
            names.append(head)
            how = f"{say_column('station', '+'.join(names))} tells them apart"
            meaning = "another transmitter for each value"
            how = "a file for each value takes them apart" if wide else how
        notes.append(Caution(f"column {head!r} is not used and explains {share}: {meaning}? {how}"))
    return notes
