"""Fingerprints: levels of access points whose places nobody knows, heard at known places.

An archive (npz, HDF5) holds `rss_dbm` (S, P), NaN where nothing was heard, and `position` (S, 2) or
(S, 3). A table (CSV) has the columns of UJIIndoorLoc (J. Torres-Sospedra et al., "UJIIndoorLoc: a
new multi-building and multi-floor database for WLAN fingerprint-based indoor localization
problems", IPIN 2014).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from gsparc.base.errors import DataError, list_first, readable
from gsparc.base.limits import choice
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import make_split
from gsparc.datasets.campaign import check_layout
from gsparc.tables import is_table
from gsparc.tables.raw import Raw, read_raw

How = Literal["released", "random", "places", "blocks", "walks", "later"]
SILENT = 100.0  # of a table: not heard
LOUDEST, FAINTEST = 20.0, -160.0  # levels of no receiver lie beyond [dBm]
STOREY_M = 3.7  # between floors of a table, which has no heights
NUMBERS = {
    "floor": "floor",
    "building": "building",
    "walk": "walk",
    "month": "campaign",
    "round": "campaign",
}
COLUMNS = {"FLOOR": "floor", "BUILDINGID": "building", "TIMESTAMP": "time_s"}


@dataclass(frozen=True)
class Fingerprints:
    """S rows of P access points.

    Attributes:
        level: (S, P) float32 [dBm], NaN where an access point was not heard.
        position: (S, 3) float64 [m].
        floor, building, walk, campaign: (S,) int64, 0 where the file has none.
        test: (S,) bool, rows that the release keeps for testing.
        time_s: (S,) float64, 0 where the file has none.
        access_point: (P,) names, text.
    """

    level: np.ndarray
    position: np.ndarray
    floor: np.ndarray
    building: np.ndarray
    walk: np.ndarray
    campaign: np.ndarray
    test: np.ndarray
    time_s: np.ndarray
    access_point: np.ndarray

    def subset(self, rows: np.ndarray) -> Fingerprints:
        """Return the rows (n,) alone."""
        parts = {
            f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "access_point"
        }
        return replace(self, **parts)

    def select_access_points(self, names: np.ndarray) -> Fingerprints:
        """Return columns in the order of `names` (P,) of another campaign;
        NaN where they are not here.
        """
        column = {name: number for number, name in enumerate(self.access_point.tolist())}
        columns = np.array([column.get(name, -1) for name in names.tolist()])
        if not (columns >= 0).any():
            raise DataError(
                f"no access point of {list_first(list(names))} is among {list_first([*column])}"
            )
        level = np.where(columns >= 0, self.level[:, columns], np.nan)
        return replace(self, level=level, access_point=names)


def read_fingerprints(path: str | Path, placed: bool = True) -> Fingerprints:
    """Read rows of an archive or a table; NaN stands for lacking places,
    unless they must be `placed`.

    Example:
        rows = read_fingerprints("wifine-floor4.npz")
        train, test = parted(rows, "walks")

    Raises:
        DataError: no such file, or something in it is missing or wrong.
    """
    path = Path(path)
    raw = _of_table(path, placed) if is_table(path) else read_raw(path)
    if not placed:
        raw.arrays.setdefault("position", np.full((len(raw.arrays.get("rss_dbm", ())), 3), np.nan))
    checked = check_layout(raw, path, "fingerprints", places=["position"] * placed)
    level, position = checked["rss_dbm"].astype(np.float32), checked["position"].astype(np.float64)
    count, dimensions = position.shape
    if dimensions not in (2, 3):
        raise DataError(f"{path}, position: expected 2 or 3 coordinates, found {dimensions}")
    if np.isnan(level).all():
        raise DataError(
            f"{path}, rss_dbm: no row heard an access point; expected levels in dBm, else NaN"
        )
    wrong = np.argwhere((level > LOUDEST) | (level < FAINTEST))
    if len(wrong):
        row, column = wrong[0]
        fault = f"{level[row, column]:g} in row {row}, column {column}; NaN stands for not heard"
        raise DataError(f"{path}, rss_dbm: expected {FAINTEST:g} to {LOUDEST:g} dBm, found {fault}")
    numbers = {field: np.zeros(count, np.int64) for field in NUMBERS.values()}
    for name in NUMBERS.keys() & checked:
        numbers[NUMBERS[name]] = np.broadcast_to(checked[name], count).astype(np.int64)
    names = checked.get("access_point", np.arange(level.shape[1])).astype(str)
    if len(np.unique(names)) < len(names):
        twice = f"a name twice in {list_first(list(names))}"
        raise DataError(f"{path}, access_point: {twice}; expected each once")
    return Fingerprints(
        level=level,
        position=np.pad(position, ((0, 0), (0, 3 - dimensions))),
        **numbers,
        test=checked.get("test", np.zeros(count)).astype(bool),
        time_s=checked.get("time_s", np.zeros(count)).astype(np.float64),
        access_point=names,
    )


def _of_table(path: Path, placed: bool) -> Raw:
    """The same arrays of a table with columns WAP001, ..., LONGITUDE, LATITUDE [m], FLOOR,
    BUILDINGID.
    """
    import pandas as pd  # half a second

    with readable(path, "not readable as CSV text", (ValueError, OSError)):
        frame = pd.read_csv(path, skipinitialspace=True)
    names = [name for name in frame.columns if name.startswith("WAP")]
    places = ["LONGITUDE", "LATITUDE"] if placed or "LONGITUDE" in frame else []
    missing = [name for name in places if name not in frame] or ([] if names else ["WAP001"])
    if missing:
        raise DataError(
            f"{path}, line 1: no column {missing[0]}; expected the columns of UJIIndoorLoc"
        )
    for name in (*names, *places, *(COLUMNS.keys() & set(frame.columns))):
        if frame[name].dtype.kind not in "iuf":
            raise DataError(
                f"{path}, column {name}: expected numbers, found {frame[name].iloc[0]!r}"
            )
    arrays = {field: frame[name].to_numpy() for name, field in COLUMNS.items() if name in frame}
    height = STOREY_M * arrays.get("floor", np.zeros(len(frame)))
    level = frame[names].replace(SILENT, np.nan).to_numpy(np.float32)
    if places:
        arrays["position"] = np.c_[frame[places].to_numpy(np.float64), height]
    return Raw({"rss_dbm": level, "access_point": np.array(names), **arrays})


def split_fingerprints(
    rows: Fingerprints,
    how: How = "released",
    side_m: float = 1.0,
    share: float = 0.2,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Part rows into training and test (n,), (m,), sorted; a pure function of its arguments.

    Args:
        how: `released`: as the file says; `random`: rows; `places`: all rows of cubes of `side_m`
            [m]; `blocks`: of squares of floor, all floors alike; `walks`: whole ones; `later`:
            campaigns after the first.
        share: held out, of rows, places, squares or walks.

    Raises:
        DataError: there is no such split, or one part of it is empty.
    """
    choice(*get_args(How)).check("split", how)
    if how in ("released", "later"):
        test = rows.test if how == "released" else rows.campaign > rows.campaign.min()
        if test.all() or not test.any():
            raise DataError(
                f"split={how}: the file names no such rows; take random, places or blocks"
            )
        return np.flatnonzero(~test), np.flatnonzero(test)
    name = {"walks": "runs", "blocks": "blocks"}.get(how, "random")
    settings = SplitSettings(name, seed, 0.0, share, side_m=side_m, share=share)
    cube = np.unique(np.floor(rows.position / side_m), axis=0, return_inverse=True)[1].reshape(-1)
    place = cube if how == "places" else None
    fold = make_split(rows.position, settings, place=place, station=rows.walk).folds[0]
    return np.sort(fold.learned()), fold.test
