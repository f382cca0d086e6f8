"""A hundred correct tables, each with one thing changed: it loads right, or is refused in a line.

Not among the changes is what no reader can see: another digit, x and y swapped in a room, a sign in one row,
another name where nothing lists the names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np

from gsparc.data.errors import DataError
from gsparc.data.own import interpret
from gsparc.data.schema import Measurements
from gsparc.data.tables.read import parse_table

COUNT = 18  # places
STATIONS = ("roof", "#2", "7", "mast east", "-1", "1")
SAME, REFUSED, EITHER = "same", "refused", "either"
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048}
SWAPPED = {"lat": "lon", "lon": "lat", "x": "y", "y": "x"}


@dataclass(frozen=True)
class Drive:
    """A table before it is text: columns of numbers, names or None, and how they are written."""

    columns: dict[str, list]
    separator: str = ","
    decimal: str = "."
    digits: int = 3
    comment: str = ""  # before the heads
    above: tuple[str, ...] = ()
    ending: str = "\n"
    encoding: str = "utf-8"
    said: dict[str, object] = field(default_factory=dict)
    listed: dict[str, list] | None = None
    changed: tuple[str, ...] | None = None  # lines instead of all this

    def number(self, value: float, how: str = "") -> str:
        return f"{value:{how}.{self.digits}f}".replace(".", self.decimal)

    def cell(self, value: object) -> str:
        if value is None:
            return "NA" if self.separator == " " else ""
        text = value if isinstance(value, str) else self.number(value)
        return f'"{text}"' if self.separator in text or text[:1] in "#%/" else text

    def lines(self) -> list[str]:
        if self.changed is not None:
            return list(self.changed)
        gap = "_" if self.separator == " " else " "
        heads = self.separator.join(self.cell(head.replace(" ", gap)) for head in self.columns)
        rows = zip(*self.columns.values(), strict=True)
        return [
            *self.above, self.comment + heads, *(self.separator.join(map(self.cell, row)) for row in rows),
        ]  # fmt: skip

    def renamed(self, names: dict[str, str]) -> Drive:
        return replace(self, columns={names.get(head, head): values for head, values in self.columns.items()})

    def with_values(self, heads: Collection[str], change: Callable[[float], object]) -> Drive:
        """With the numbers of some columns changed."""
        columns = {
            head: [change(v) if head in heads and isinstance(v, float) else v for v in values]
            for head, values in self.columns.items()
        }
        return replace(self, columns=columns)

    def of_stations(self) -> str | None:
        """The column of stations, where there is one."""
        return next((head for head in ("station", "Cell ID") if head in self.columns), None)

    def on_a_map(self) -> bool:
        """Whether places are far from 0, and stations are there to compare with."""
        other = self.listed is not None or any(h.startswith(("station_", "tx_")) for h in self.columns)
        return other and abs(np.mean(self.columns.get("x", [1e6]))) > 1e3

    def with_line(self, row: int, *instead: str) -> Drive:
        lines = self.lines()
        return replace(self, changed=(*lines[:row], *instead, *(lines[row:][1:])))


def draw(rng: np.random.Generator) -> Drive:
    """A correct table."""

    def one(*choices):
        return choices[rng.integers(len(choices))]

    kind = one("rssi_db", "rssi_db", "rssi", "csi", "tones")
    system = one("local", "utm", "degrees", "degrees west")
    forms = ("listed", "columns", "fixed") + ("wide", "wide", "alone") * ("rssi" in kind)
    form, separator = one(*forms), one(",", ",", ";", "\t", "|", " ")
    names = list(map(str, rng.permutation(STATIONS)[: rng.integers(2, 5)]))
    names = [name.replace(" ", "-" if separator == " " else " ") for name in names]
    degrees = "deg" in system
    middle = {"local": (5, 4), "utm": (691_500, 5_334_500), "degrees": (48.1, 11.5)}.get(
        system, (40.76, -111.8)
    )
    step, axes = (1e-4, ("lat", "lon")) if degrees else (4.0, ("x", "y"))
    along = np.column_stack([np.arange(COUNT), np.arange(COUNT) ** 2 % 7]) + rng.random((COUNT, 2)) / 2
    place, posts = np.array(middle) + step * along, np.array(middle) + step * rng.uniform(-9, 30, (4, 2))
    which = np.arange(COUNT) % len(names)
    columns: dict[str, list] = {axis: place[:, i].tolist() for i, axis in enumerate(axes)}
    if one(True, False):
        columns["height" if degrees else "z"] = rng.uniform(1, 3, COUNT).tolist()
    if form == "fixed":
        columns |= {f"tx_{axis}": [float(posts[0, i])] * COUNT for i, axis in enumerate(axes)}
    if form in ("listed", "columns"):
        columns = {one("station", "Cell ID"): [names[t] for t in which], **columns}
    if form == "columns":
        columns |= {f"station_{axis}": posts[which, i].tolist() for i, axis in enumerate(axes)}
    if form == "wide":
        style = "power_{} [mW]" if kind == "rssi" else one("{}", "rssi_{}", "RSRP {} [dBm]")
        heads = [style.format(name) for name in names]
    elif "rssi" in kind:
        heads = ["power [mW]"] if kind == "rssi" else [one("RSRP [dBm]", "rssi", "level (dBm)")]
    else:
        tones = [""] if kind == "csi" else one("012", (-2, -1, 1, 2), (-11, -1, 1, 9, 11))
        style = one("csi_{}_{}", "h {} {}") if kind == "tones" else "{}{}"
        heads = [style.format(part, tone) for tone in tones for part in ("re", "im")]
    low, high = {"rssi": (1, 900), "rssi_db": (-110, -50)}.get(kind, (-9, 9))
    for head in heads:
        columns[head] = rng.uniform(low, high, COUNT).round(3).tolist()
        if kind == "rssi_db":
            columns[head][int(rng.integers(COUNT))] = one(None, "n/a", "NaN", 0.0 + low)
    if form == "fixed" and one(True, False):
        columns["run"] = [one("a", "b") for _ in range(COUNT)]
    listed = None
    if form in ("listed", "wide"):
        listed = {"name": names, **{axis: posts[: len(names), i].tolist() for i, axis in enumerate(axes)}}
        listed["height"] = [5.0 + i for i in range(len(names))]
        if kind == "rssi_db" and one(True, False):
            listed["sensitivity_db"] = [-120.0 - i for i in range(len(names))]
    said = {} if "rssi" in kind else {"frequency_hz": 2.4e9 if kind == "csi" else "2.40e9:2.44e9"}
    return Drive(
        columns, separator, one(".", ",") if separator in ";\t|" else ".", 7 if degrees else 3,
        one("", "", "# ", "%"), one((), (), ("# by hand, on a Monday",), ("% one", "// two; three")),
        one("\n", "\r\n"), one("utf-8", "utf-8-sig", "utf-16"), said, listed,
    )  # fmt: skip


class Changes:
    """Each makes of a table another one and says what must come of it; None where it cannot be made."""

    def columns_in_another_order(drive, rng):
        heads = [list(drive.columns)[i] for i in rng.permutation(len(drive.columns))]
        return replace(drive, columns={head: drive.columns[head] for head in heads}), SAME

    def rows_in_another_order(drive, rng):
        order = rng.permutation(COUNT)
        return replace(drive, columns={h: [v[i] for i in order] for h, v in drive.columns.items()}), SAME

    def stations_in_another_order(drive, rng):
        if drive.listed is not None:
            return replace(drive, listed={h: v[::-1] for h, v in drive.listed.items()}), SAME

    def another_unit(drive, rng):
        unit = str(rng.choice(list(LENGTHS)))
        heads = [h for h in drive.columns if h.split("_")[-1] in ("x", "y", "z")]
        style = ("{} [{}]", "{} ({})", "{}_{}", "{}/{}")[rng.integers(4)]
        if heads:
            changed = replace(drive.with_values(heads, lambda v: v / LENGTHS[unit]), digits=8)
            return changed.renamed({head: style.format(head, unit) for head in heads}), SAME

    def radians(drive, rng):
        heads = [h for h in drive.columns if h.endswith(("lat", "lon"))]
        if heads:
            changed = replace(drive.with_values(heads, np.radians), digits=10)
            return changed.renamed({h: f"{h} [rad]" for h in heads}), SAME

    def another_unit_of_levels(drive, rng):
        levels, watts = ([h for h in drive.columns if unit in h] for unit in ("dBm", "mW"))
        if levels or watts:
            changed = drive.with_values(levels, lambda v: v - 30).with_values(watts, lambda v: v / 1e3)
            names = {h: h.replace("mW", "W").replace("dBm", "dBW") for h in levels + watts}
            return replace(changed, digits=9).renamed(names), SAME

    def axes_swapped(drive, rng):
        if drive.on_a_map():
            return drive.renamed(SWAPPED), REFUSED

    def a_sign_lost(drive, rng):
        head = str(rng.choice(["lat", "lon", "y"]))
        if head in drive.columns and drive.on_a_map():
            return drive.with_values([head], lambda v: -v), REFUSED

    def another_separator_in_a_line(drive, rng):
        row, other = -1 - int(rng.integers(COUNT)), ";" if drive.separator == "|" else "|"
        if drive.separator != " ":
            return drive.with_line(row, drive.lines()[row].replace(drive.separator, other)), REFUSED

    def another_decimal_mark(drive, rng):
        return replace(drive, separator=";", decimal="," if drive.decimal == "." else "."), SAME

    def another_decimal_mark_in_a_line(drive, rng):
        row, marks = -1 - int(rng.integers(COUNT)), (".", ",") if drive.decimal == "." else (",", ".")
        return drive.with_line(row, drive.lines()[row].replace(*marks, 1)), REFUSED

    def marks_between_thousands(drive, rng):
        marks = str.maketrans(",.", ".," if drive.decimal == "," else ",.")
        for head in ("y", "tx_y", "station_y"):
            if abs(drive.columns.get(head, [0])[0]) > 1e4:
                return drive.with_values([head], lambda v: f"{v:,.3f}".translate(marks)), REFUSED

    def a_comment_among_rows(drive, rng):
        row = -1 - int(rng.integers(COUNT))
        text = drive.separator.join(["# turned", "back", "here", "and", "there"][: int(rng.integers(1, 6))])
        return drive.with_line(row, text, drive.lines()[row]), EITHER

    def a_sign_in_a_head(drive, rng):
        heads = [h for h in drive.columns if h[:4] in ("csi_", "h re", "h im") and h[-1] in "123456789"]
        if heads:
            head = str(rng.choice(heads))
            at = max(head.rfind("_"), head.rfind(" ")) + 1
            turned = head[:at] + str(-int(head[at:]))
            return drive.renamed(
                {head: turned if turned not in drive.columns else head[:at] + "0" + turned[at:]}
            ), REFUSED

    def plus_signs(drive, rng):
        return drive.with_values(drive.columns, lambda v: drive.number(v, "+")), SAME

    def another_minus(drive, rng):
        return drive.with_values(drive.columns, lambda v: drive.number(v).replace("-", "\u2212")), EITHER

    def exponents(drive, rng):
        return drive.with_values(drive.columns, lambda v: f"{v:.12e}".replace(".", drive.decimal)), SAME

    def a_station_misspelt(drive, rng):
        if drive.listed is not None:
            names = [name + "b" * (i == 0) for i, name in enumerate(drive.listed["name"])]
            return replace(drive, listed={**drive.listed, "name": names}), REFUSED

    def stations_by_their_numbers(drive, rng):
        head = drive.of_stations()
        if head is not None and drive.listed is not None and not {"0", "1"} & set(drive.listed["name"]):
            numbers = [str(drive.listed["name"].index(name)) for name in drive.columns[head]]
            return replace(drive, columns={**drive.columns, head: numbers}), REFUSED

    def a_column_more(drive, rng):
        more = {
            "battery_level": 3.5, "rssi_delta": 1.0, "SINR": 12.0, "tx_power_dbm": 30.0, "time": "12:30:05",
            "": 4.0,
        }  # fmt: skip
        head = str(rng.choice(list(more)))
        return replace(drive, columns={**drive.columns, head: [more[head]] * COUNT}), EITHER


CHANGES = [change for name, change in vars(Changes).items() if not name.startswith("_")]


def load(drive: Drive, folder) -> Measurements:
    (folder / "a.csv").write_bytes(drive.ending.join(drive.lines()).encode(drive.encoding))
    stations = None
    if drive.listed is not None:
        stations = folder / "stations.csv"
        stations.write_text("\n".join(Drive(drive.listed, ";", ",", 9).lines()))
    return interpret(parse_table(folder / "a.csv", drive.said, stations), "a.csv").data


def rows_of(data: Measurements) -> list[tuple]:
    """Name of the station, run, both places (6,) in the world, and what was measured, of every row."""
    ends = np.nan_to_num(np.hstack([end + data.site.origin for end in (data.tx, data.rx_position)]))
    stations = data.site.stations
    names = [""] * len(data) if stations is None else [stations.name[t] for t in data.station]
    run = np.zeros(len(data)) if data.run is None else data.run
    values = data.target.reshape(len(data), -1).astype(complex) * data.site.target_scale
    heard = np.ones(len(data)) if data.censored is None else data.censored == 0
    return list(zip(names, run, heard, ends, values, strict=True))


def same(one: Measurements, other: Measurements) -> bool:
    """Whether both hold the same rows, in any order."""
    left = rows_of(other)
    for name, run, heard, ends, values in rows_of(one):
        near = [
            i for i, row in enumerate(left)
            if row[:3] == (name, run, heard) and np.abs(row[3] - ends).max() < 0.02
            and row[4].shape == values.shape and np.allclose(row[4], values, rtol=1e-3, atol=0)
        ]  # fmt: skip
        if len(near) != 1:
            return False
        del left[near[0]]
    facts = [
        (site.kind, site.static_end, np.round(site.tones() / 1e3).tolist() if site.kind == "csi" else [])
        for site in (one.site, other.site)
    ]
    return not left and facts[0] == facts[1]


def test_a_table_with_one_thing_changed_loads_right_or_is_refused(tmp_path):
    came: Counter[tuple[str, str]] = Counter()
    rng = np.random.default_rng(39)
    for number in range(100):
        change, made = CHANGES[number % len(CHANGES)], None
        while made is None:
            drive = draw(rng)
            made = change(drive, rng)
        whole = load(drive, tmp_path)
        where = f"table {number}, {change.__name__}: "
        try:
            found = load(made[0], tmp_path)
        except DataError as error:
            assert made[1] != SAME, where + str(error)
            assert all("\n" not in line for line in error.problems), where + str(error)
            came[change.__name__, REFUSED] += 1
        else:
            assert made[1] != REFUSED, where + "was not refused"
            assert same(whole, found), where + "was read as something else"
            came[change.__name__, SAME] += 1
    assert sum(count for (_, what), count in came.items() if what == SAME) >= 35, came
