"""What a list of sites says of its sectors, by the heads that planning tools write."""

from __future__ import annotations

import numpy as np
import pandas as pd

from gsparc.data.errors import Caution
from gsparc.data.tables.heads import unit_of, words_of
from gsparc.data.tables.sheet import Sheet

# What the words of a head say, without those in OTHER: the first that fits. A sector's tilts are added.
SAID: dict[str, str] = {
    "station_width": "hbw|hpbw|beamwidth|beam width|horizontal beamwidth|h beamwidth|h bw|"
    "horizontal beam width|azimuth beamwidth|horizontal hpbw|hbeamwidth",
    "station_thickness": "vbw|vertical beamwidth|v beamwidth|v bw|vertical beam width|elevation beamwidth|"
    "vertical hpbw|vbeamwidth",
    "station_azimuth": "azimuth|azi|bearing|direction|heading|boresight",
    "mechanical": "mechanical tilt|mech tilt|m tilt|mtilt|mdt|mechanical downtilt|mech downtilt|"
    "tilt mechanical",
    "electrical": "electrical tilt|elec tilt|e tilt|etilt|edt|ret|el tilt|electrical downtilt|"
    "tilt electrical",
    "total": "tilt|downtilt|total tilt|down tilt|total downtilt",
    "station_power_db": "power|tx power|txpower|eirp|erp|rs power|max power|rs eirp|transmit power|pmax",
    "height": "height|agl|height agl|hba|height above ground",
    "earfcn": "earfcn|dl earfcn|earfcn dl|dlearfcn",
    "carrier_hz": "frequency|freq|dl frequency|dl freq|carrier|carrier frequency",
    "band": "band|frequency band|lte band|freq band",
}
HEADS = {text: name for name, texts in SAID.items() for text in texts.split("|")}
SITES = {  # heads of what sectors of one site have alike
    *("site", "site id", "site name", "site code", "enodeb", "enodeb id", "enodeb name", "enb", "enb id"),
    *("gnodeb", "gnodeb id", "gnodeb name", "gnb id", "nodeb", "mast", "tower", "bts", "base station"),
}
OTHER = {
    *("antenna", "ant", "sector", "cell", "site", "deg", "degree", "degrees", "dbm", "mhz", "of", "the"),
}
# 3GPP TS 36.101, table 5.7.3-1: lowest downlink frequency [MHz] of a band, and its first EARFCN.
BANDS = {
    **{1: (2110.0, 0), 2: (1930.0, 600), 3: (1805.0, 1200), 4: (2110.0, 1950), 5: (869.0, 2400)},
    **{7: (2620.0, 2750), 8: (925.0, 3450), 11: (1475.9, 4750), 12: (729.0, 5010), 13: (746.0, 5180)},
    **{14: (758.0, 5280), 17: (734.0, 5730), 18: (860.0, 5850), 19: (875.0, 6000), 20: (791.0, 6150)},
    **{21: (1495.9, 6450), 25: (1930.0, 8040), 26: (859.0, 8690), 28: (758.0, 9210), 32: (1452.0, 9920)},
    **{34: (2010.0, 36200), 38: (2570.0, 37750), 39: (1880.0, 38250), 40: (2300.0, 38650)},
    **{
        41: (2496.0, 39650),
        42: (3400.0, 41590),
        43: (3600.0, 43590),
        66: (2110.0, 66436),
        71: (617.0, 68586),
    },
}
TILTS = ("total", "mechanical", "electrical")
MOST_BAND = 90  # numbers beyond are frequencies [MHz]
MHZ = 1e6


def meaning(head: str) -> str | None:
    """What a head of a list says of a sector; None: nothing."""
    words = " ".join(word for word in words_of(unit_of(head)[0]) if word not in OTHER)
    return HEADS.get(words)


def earfcn_hz(channel: np.ndarray) -> np.ndarray:
    """Downlink frequencies (n,) [Hz] of LTE channel numbers (n,), NaN of none (3GPP TS 36.101, 5.7.3)."""
    lowest = sorted(BANDS.values(), key=lambda band: band[1])
    first = np.array([band[1] for band in lowest])
    at = np.searchsorted(first, np.nan_to_num(channel, nan=-1), side="right") - 1
    start = np.array([band[0] for band in lowest])[at.clip(0)]
    return np.where(at >= 0, (start + 0.1 * (channel - first[at.clip(0)])) * MHZ, np.nan)


def band_hz(band: np.ndarray) -> np.ndarray:
    """Lowest downlink frequencies (n,) [Hz] of LTE bands (n,), or of frequencies [MHz] that name one."""
    known = [BANDS.get(int(number), (np.nan,))[0] for number in np.nan_to_num(band)]
    return np.where(band > MOST_BAND, band, known) * MHZ


def read_sectors(sheet: Sheet, used: set[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays (T,) by name of what a list says of its sectors, `height` and `carrier_hz` among them; notes.

    Args:
        sheet: the list.
        used: heads that are read as something else.
    """
    found: dict[str, np.ndarray] = {}
    notes, unread, heads = [], [], []
    for head in sheet.heads:
        name = meaning(head) if head and head not in used else None
        unit = unit_of(head)[1] if head else None
        words = sheet.words(head) if name else np.zeros(0, str)
        values = pd.to_numeric(pd.Series([_number(word) for word in words]), errors="coerce").to_numpy(float)
        if name is None or name in found or not np.isfinite(values).any():
            if head and head not in used:
                unread.append(repr(head))
            continue
        if name == "carrier_hz" and unit is None and np.nanmax(values) < MHZ:
            values = values * MHZ
        elif unit is not None and unit.kind == "power" and name == "station_power_db":
            with np.errstate(divide="ignore", invalid="ignore"):
                values = 10 * np.log10(unit.convert(values)) + 30
        elif unit is not None:
            values = unit.convert(values)
        found[name] = values
        heads.append(f"{head!r} as {name}")
    parts = [found.pop(name) for name in TILTS if name in found]
    if parts:
        total = np.nansum(parts[-2:] if len(parts) < 3 else parts[:1], axis=0)
        found["station_tilt"] = np.where(np.isnan(parts).all(0), np.nan, total)
    for name, turned in (("earfcn", earfcn_hz), ("band", band_hz)):
        if name in found:
            carrier = turned(found.pop(name))
            if np.isfinite(carrier).all():
                found.setdefault("carrier_hz", carrier)
    if heads:
        notes.append(f"{sheet.source}: of sectors {', '.join(heads)}")
    if unread:
        many = f" and {len(unread) - 8} more" if len(unread) > 8 else ""
        notes.append(
            Caution(
                f"{sheet.source}: not read: column{'s' * (len(unread) > 1)} {', '.join(unread[:8])}{many}"
            )
        )
    return found, notes


def sites_of(sheet: Sheet) -> np.ndarray | None:
    """Numbers (T,) float64 of the sites that a column of the list names; None where none does."""
    for head in sheet.heads:
        words = sheet.words(head) if head and " ".join(words_of(head)) in SITES else np.zeros(0, str)
        number, names = pd.factorize(words)
        if 1 < len(names) < len(words) and (words != "").all():
            return number.astype(np.float64)
    return None


def _number(word: str) -> str:
    """The number that a cell begins with: `30°`, `B20`, `1800 MHz`."""
    text = word.replace(",", ".").strip().lstrip("Bbn")
    return text.split()[0].rstrip("°") if text.split() else ""
