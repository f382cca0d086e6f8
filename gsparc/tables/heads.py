"""What the head of a column says: which quantity, of which end or station, in which unit."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any
from unicodedata import combining, normalize

import yaml

from gsparc.base.limits import LONGEST_HEAD
from gsparc.data.units import UNITS, Unit

PERCENT = (
    "a quality, not a level: export levels in dBm; where a driver made it of them as Windows does, "
    "they are quality / 2 - 100"
)

# Quantities a column can hold: of an end (the moving one when it is not named), and of a row.
ENDS = ("", "rx_", "tx_", "station_")
AXES = {"x": "length", "y": "length", "z": "length", "latitude": "angle", "longitude": "angle"}
LEVELS, CHANNELS, POLAR = ("rssi_db", "rssi"), ("csi_re", "csi_im"), ("csi_amp", "csi_phase")
MANY = (*LEVELS, *CHANNELS, *POLAR)  # may be several columns: stations, or frequencies
OTHER_NAMES = {"lat": "latitude", "lon": "longitude", "lng": "longitude", "height": "z"}
OTHER_NAMES |= {
    f"{end}{short}": f"{end}{long}" for end in ENDS for short, long in OTHER_NAMES.items()
}


def meaning_by_word(table: str) -> dict[str, str]:
    """Return which entry of a table of words.yaml each of its words stands for."""
    return {word: meaning for meaning, words in SHEET[table].items() for word in words.split()}


SHEET: dict[str, Any] = yaml.safe_load(
    files(__package__).joinpath("words.yaml").read_text(encoding="utf-8")
)
LISTS = {name: set(words.split()) for name, words in SHEET.items() if isinstance(words, str)}
KINDS = {f"{end}{axis}": kind for end in ENDS for axis, kind in AXES.items()} | meaning_by_word(
    "kinds"
)
STATION_WORDS, END_WORDS = LISTS["station"], meaning_by_word("ends")
TOGETHER = {
    word: set(parts.split()) for parts, words in SHEET["together"].items() for word in words.split()
}
AXIS_WORDS, PARTS = meaning_by_word("axes"), meaning_by_word("part")


@dataclass(frozen=True)
class Head:
    """What a head says.

    Attributes:
        role: one of `KINDS`; None where it says nothing that is known.
        label: the rest, where the role may be several columns: name of a station, or number of a
            frequency.
        unit: where it says one.
        word: what named the role, in small letters.
        strange: text in brackets that is no known unit.
        less: whether it yields to another column of the same role.
    """

    role: str | None = None
    label: str = ""
    unit: Unit | None = None
    word: str = ""
    strange: str = ""
    less: bool = False


def parse_head(text: str) -> Head:
    """Read a head such as `RSRP [dBm]`, `tx_x_mm`, `Latitude (deg)`,
    `rssi_gateway7` or `csi_re_3`.
    """
    if len(text) > LONGEST_HEAD:
        return Head()
    plain, unit, strange = unit_of(text)
    words = words_of(plain)
    if not words:
        return Head(unit=unit, strange=strange)
    if unit is None and len(words) > 1 and words[-1] in UNITS:
        # A last word may be a unit or a name (`tx_m`): it is a unit where it suits the rest.
        last = UNITS[words[-1]]
        cut = re.sub(rf"[\W_]*{re.escape(words[-1])}\W*$", "", plain, flags=re.IGNORECASE)
        head = _role(words[:-1], last, cut)
        if head.role and (unit_suits(head.role, last) or last.kind == "quality"):
            return head
    head = _role(words, unit, plain)
    return replace(head, unit=unit, strange=strange)


def station_in_head(text: str) -> str:
    """Return what is left of a head without its unit and what says a level or a station.

    >>> [station_in_head(head) for head in ("PCI 101", "101_RSRP", "101 [dBm]", "RSRP")]
    ['101', '101', '101', '']
    """
    head = parse_head(text)
    if head.role in LEVELS:
        return head.label
    return re.sub(rf"(?i)^[\W_]*(?:{'|'.join(STATION_WORDS)})[\W_]+", "", unit_of(text)[0]).strip()


def match_pattern(pattern: str, names: Iterable[str]) -> dict[str, str]:
    """Return what the one `*` of a pattern stands for, by the heads that it names.

    >>> match_pattern("RSSI_*", ["x", "RSSI_a", "RSSI_b"])
    {'RSSI_a': 'a', 'RSSI_b': 'b'}
    """
    before, star, after = pattern.partition("*")
    fits = [name for name in names if name.startswith(before) and name.endswith(after)]
    one = star and "*" not in after
    long = len(before) + len(after)
    return {n: n[len(before) : len(n) - len(after)] for n in fits if one and len(n) > long}


def unit_suits(role: str, unit: Unit) -> bool:
    """Tell whether a column of `role` can be in `unit`."""
    return KINDS[role] == unit.kind or (role, unit.kind) in (
        ("csi_phase", "angle"),
        ("csi_amp", "level"),
    )


def unit_of(text: str) -> tuple[str, Unit | None, str]:
    """Return a head without its unit, the unit,
    and text in square brackets that is no known unit.
    """
    match = re.search(r"\s*(?:\[([^\]]*)\]|\(([^)]*)\)|/\s*([^\s/]+))\s*$", text)
    if match is None:
        return text, None, ""
    inside = next(part for part in match.groups() if part is not None).strip()
    if inside.lower() in UNITS:
        return text[: match.start()], UNITS[inside.lower()], ""
    if re.fullmatch(r"[-+]?\d+", inside):  # csi_re[3]
        return text, None, ""
    if match[1] is None and not re.search(r"%|^dB", inside):  # may be words: RSRP (serving)
        return text, None, ""
    return text[: match.start()], None, inside


def words_of(text: str) -> list[str]:
    """Split a head into small words: `RxPower_mean` is rx, power, mean."""
    text = "".join(letter for letter in normalize("NFD", text) if not combining(letter))
    text = re.sub(r"(?i)(?<![a-z])([eg])node[ _-]?b", r"\1nb", text)  # eNodeB is one word
    text = re.sub(r"(?i)physical[ _]*(?:layer[ _]*)?cell[ _]*id(?:entity)?", "pci", text)
    phrase = re.sub(r"(?<=[a-z0-9])(?=[A-Z])(?!Bm?\b|BW\b|Hz|W\b)", " ", text)
    phrase = re.sub(
        r"(rssi|rsrp|rss|power|level|signal|rscp|dbm)(?=\d)", r"\1 ", phrase, flags=re.IGNORECASE
    )
    return [word for word in re.split(r"[^0-9a-zµμ°]+", phrase.lower()) if word]


def _role(words: list[str], unit: Unit | None, plain: str) -> Head:
    # position_3 of an array's column
    if words[-1] in ("1", "2", "3") and LISTS["vector"] & set(words):
        words = [*words[:-1], "xyz"[int(words[-1]) - 1]]
    rest = [word for word in words if word not in LISTS["place"]]
    joined = "_".join(rest)
    role = OTHER_NAMES.get(joined, joined)
    if role in KINDS and role != "rssi":  # which is watts in the schema, but dBm in most logs
        return Head(role, unit=unit, word=joined)
    measured = _level(words, unit, plain) or _channel(words, unit, plain)
    head = _axis(rest, unit) or measured or _text(words, unit)
    if (
        head.role
        or unit is None
        or unit.name not in ("dBm", "dBW")
        or LISTS["no_level"] & set(words)
    ):
        return head
    return Head("rssi_db", plain.strip("_ "), unit, less=True)  # in any language


def _axis(rest: list[str], unit: Unit | None) -> Head | None:
    axes = [word for word in rest if word in AXIS_WORDS]
    above = len(axes) == 1 and AXIS_WORDS[axes[0]] == "z"
    ends = [
        word for word in rest if word not in AXIS_WORDS and not (above and word in LISTS["above"])
    ]
    less = len(ends) + len(axes) < len(rest)
    if len(axes) != 1 or len(ends) > 1:
        return None
    if not ends:
        return Head(AXIS_WORDS[axes[0]], unit=unit, word=axes[0], less=less)
    end = "station_" if ends[0] in STATION_WORDS else END_WORDS.get(ends[0])
    return (
        None if end is None else Head(end + AXIS_WORDS[axes[0]], unit=unit, word=axes[0], less=less)
    )


def _level(words: list[str], unit: Unit | None, plain: str) -> Head | None:
    named = [word for word in words if word in LISTS["level"]]
    if not named or LISTS["no_level"] & set(words):
        return None
    # 'signal strength' and 'signal power' are one thing said twice.
    word = next((w for w in named if w != "signal"), "signal")
    rest = [
        w for w in words if w != word and w not in LISTS["about_level"] and w not in ("db", "dbm")
    ]
    label = ""
    if rest:
        # One mark between the level and the name: a sign or # after it is the name's.
        around = rf"(?:[\s_.:/(\[]+|-)?(?<![a-z]){word}(?:[\W_]*dbm?(?![a-z]))?(?:[\s_.:/)\]]+|-)?"
        label = re.sub(around, " ", plain, flags=re.IGNORECASE)
        label = label.strip("_ ").strip("()[]").strip("_ ")
    role = "rssi" if unit is not None and unit.kind == "power" else "rssi_db"
    return Head(role, label, unit, word)


def _channel(words: list[str], unit: Unit | None, plain: str) -> Head | None:
    numbers = [word for word in words if word.isdigit()]
    parts = [word for word in words if word in PARTS]
    tone = re.search(r"(?i)(?<!\d)\d+(?:\.\d+)?\s*[kmg]?hz\W*$", plain)  # S21_re_3.5GHz
    if len(parts) == 1 and tone is not None:
        return Head(PARTS[parts[0]], tone[0], unit, parts[0])
    others = [word for word in words if word not in {*PARTS, *numbers, *LISTS["channel"]}]
    named = bool(LISTS["channel"] & set(words))
    plainly = (
        "re",
        "im",
        "real",
        "imag",
        *("amp", "amplitude", "mag", "magnitude", "phase") * bool(numbers),
    )
    if len(parts) != 1 or not (named or parts[0] in plainly):
        return None
    # Of a channel, but not plainly the number of a tone: refused by its label
    if others or len(numbers) > 1:
        return Head(PARTS[parts[0]], " ".join(numbers + others), unit, parts[0]) if named else None
    label = numbers[0] if numbers else ""
    dash = re.search(rf"(.?)[-\u2212]{label}(?!\d)", plain) if numbers else None
    if dash is not None and not dash[1].isalnum():
        label = f"-{label}"
    elif dash is not None and "-" not in plain[: dash.start()]:
        # csi-re-2 has the mark between all words
        label = f"{label} or -{label}"
    return Head(PARTS[parts[0]], label, unit, parts[0])


def _text(words: list[str], unit: Unit | None) -> Head:
    rest = [word for word in words if word not in LISTS["labels"]]
    if len(rest) == 1 and rest[0] in STATION_WORDS:
        return Head("station", word=rest[0])
    if not rest and set(words) & LISTS["less"]:
        return Head(
            "station", word=next(word for word in words if word in LISTS["less"]), less=True
        )
    if rest == ["run"]:
        return Head("run", word="run")
    if rest and set(rest) <= LISTS["carrier"]:
        return Head("carrier_hz", unit=unit, word=rest[-1])
    return Head()
