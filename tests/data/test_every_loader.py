"""Slips of a unit or of a column, at every door that measurements come in by."""

import csv
import shutil
from pathlib import Path

import cities
import numpy as np
import pytest
from campaigns import powers
from releases import write_release

from gsparc.data.checks.outliers import outlier_warnings
from gsparc.data.checks.unit_warnings import unit_warnings
from gsparc.data.datasets.argos import load_argos
from gsparc.data.datasets.own import read_any
from gsparc.data.errors import DataError


def own(folder: Path, change) -> Path:
    """A file of the schema."""
    with np.load(powers(folder / "sound.npz")) as stored:
        arrays = {name: stored[name].copy() for name in stored.files}
    for end in ("tx_position", "rx_position"):
        arrays[end] = change(arrays[end])
    np.savez(folder / "own.npz", **arrays)
    return folder / "own.npz"


def rfid(folder: Path, change) -> Path:
    """A folder in the RFID release's layout."""
    root = write_release(folder / "release")
    rows = list(csv.reader((root / "tx_pos.csv").open()))
    places = change(np.array(rows[1:], dtype=float))
    lines = ["x,y,z", *(",".join(f"{x:.6f}" for x in place) for place in places)]
    (root / "tx_pos.csv").write_text("\n".join(lines) + "\n")
    return root


def argos(folder: Path, change) -> Path:
    """A folder in Argos' layout, with the users' positions."""
    root = shutil.copytree(cities.folder(), folder / "city")
    np.save(root / "positions.npy", change(np.load(root / "positions.npy")))
    return root


DOORS = {"argos": argos, "own": own, "rfid": rfid}  # rooms, simulators and tables come in as `own` does
EVERY = pytest.mark.parametrize("door", DOORS)


def read(door: str, path: Path):
    """Its measurements."""
    return load_argos(path, positions="true") if door == "argos" else read_any(path).data


def said(door: str, path: Path) -> str:
    """What looks wrong in it."""
    data = read(door, path)
    return "; ".join([*unit_warnings(data), *outlier_warnings(data)])


@EVERY
def test_the_sound_one_raises_no_warning(tmp_path, door):
    assert not said(door, DOORS[door](tmp_path, lambda places: places))


@EVERY
@pytest.mark.parametrize("factor,unit", [(1e3, "millimetres"), (1e-3, "kilometres")])
def test_places_in_another_unit_raise_a_warning(tmp_path, door, factor, unit):
    if door == "argos" and factor < 1:
        return  # a city in kilometres is a room in metres
    found = said(door, DOORS[door](tmp_path, lambda places: factor * places))
    assert unit in found or (factor > 1 and "centimetres" in found)


@EVERY
def test_one_place_in_another_unit_is_an_outlier(tmp_path, door):
    def one(places):
        changed = np.array(places)
        if changed.ndim == 2:
            changed[3] *= 1e4
        return changed

    assert "lie far outside the region" in said(door, DOORS[door](tmp_path, one))


@EVERY
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_a_place_that_is_none_is_refused_by_row(tmp_path, door, value):
    def wrong(places):
        changed = np.array(places, dtype=float)
        if changed.ndim == 2:
            changed[2, 1] = value
        return changed

    with pytest.raises(DataError, match=r"(row 2|line 4)"):
        read(door, DOORS[door](tmp_path, wrong))


@pytest.mark.parametrize("door", [name for name in DOORS if name != "rfid"])
def test_transposed_places_are_refused(tmp_path, door):
    with pytest.raises(DataError, match=r"transposed\?"):
        read(door, DOORS[door](tmp_path, lambda places: np.array(places).T))
