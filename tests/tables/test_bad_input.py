"""Everything a disk can hand us: refused in one clear line that names file, row and expectation."""

import io
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from releases import SPOILT

from gsparc.base.errors import DataError
from gsparc.datasets.own import read_any
from gsparc.datasets.rfid import load_rfid
from gsparc.tables.own import from_arrays, load_own, write_own


def test_rfid_unknown_gateway(rfid_folder, refused):
    says = "no gateway named 'gateway9'; there are gateway1, gateway2"
    refused(says, load_rfid, rfid_folder, gateway="gateway9")


def test_all_problems_of_a_folder_are_listed_at_once(rfid_folder):
    for case in ("csv nan", "spectrum truncated", "index twice"):
        SPOILT[case][0](rfid_folder)
    with pytest.raises(DataError, match=r"and 2 more: gsparc check") as error:
        load_rfid(rfid_folder)
    assert len(error.value.problems) == 3


def test_a_header_with_an_open_bracket_ended_in_a_traceback(tmp_path, refused):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3,".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "own.npz", "w") as archive:
        archive.writestr(
            "rssi_db.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        )
    refused("own.npz, rssi_db: damaged or not an npz file", load_own, tmp_path / "own.npz")


def _set(name, value):
    return lambda arrays: arrays | {name: value}


def _entry(name, index, value):
    def spoil(arrays):
        changed = arrays[name].copy()
        changed[index] = value
        return arrays | {name: changed}

    return spoil


def _without(name, new=None):
    """Without an array, or with it under a new name."""

    def spoil(arrays):
        rest = {key: value for key, value in arrays.items() if key != name}
        return rest if new is None else rest | {new: arrays[name]}

    return spoil


def _together(*spoils):
    def spoil(arrays):
        for one in spoils:
            arrays = one(arrays)
        return arrays

    return spoil


CSI = {
    "no measurement": (
        _without("csi"),
        "expected exactly one of spectrum, csi, rssi, rssi_db; found none",
    ),
    "two measurements": (_set("rssi", np.ones(12)), "found csi and rssi"),
    "no transmitter": (_without("tx_position"), r"tx_position: missing"),
    "no frequency": (
        _without("frequency_hz"),
        "frequency_hz: missing; csi needs the 3 frequencies",
    ),
    "misspelt": (_without("tx_position", "tx_positon"), "unknown name; did you mean 'tx_position'"),
    "real csi": (
        _set("csi", -np.ones((12, 5, 3))),
        "csi: expected complex numbers, found dtype float64",
    ),
    "csi nan": (_entry("csi", (5, 1, 1), np.nan), "csi, row 5: not finite"),
    "csi silent": (_set("csi", np.zeros((12, 2, 3), complex)), "every measured value is zero"),
    "one sample": (
        _together(_set("csi", np.ones((1, 2, 3), complex)), _set("rx_position", np.ones((1, 3)))),
        "two rows or more",
    ),
    "transposed": (_set("rx_position", np.ones((3, 12))), r"found \(3, 12\); transposed"),
    "quaternions transposed": (
        _set("rx_orientation", np.ones((4, 12))),
        r"found \(4, 12\); transposed",
    ),
    "two coordinates": (
        _set("rx_position", np.ones((12, 2))),
        "rx_position: two coordinates.* rx_height",
    ),
    "positions nan": (
        _entry("rx_position", slice(3, 6), np.nan),
        "rx_position, row 5 = .*three finite coord",
    ),
    "nothing moves": (_set("rx_position", np.ones(3)), "neither end moves"),
    "GHz": (_set("frequency_hz", np.array([2.40, 2.41, 2.42])), r"expected Hz \(not MHz or GHz\)"),
    "frequency twice": (
        _set("frequency_hz", np.array([2.4e9, 2.4e9, 2.42e9])),
        "same frequency twice",
    ),
    "one frequency for three": (
        _set("frequency_hz", np.array(2.4e9)),
        "one frequency, but csi has 3 columns",
    ),
    "antenna nan": (
        _entry("array_position", (0, 0), np.nan),
        "antenna 0 = .*three finite coordinates",
    ),
    "two orientations": (_set("rx_rotation", np.eye(3)), "both given; expected one"),
    "a mirror": (
        _together(_without("rx_orientation"), _set("rx_rotation", np.diag([1.0, 1, -1]))),
        "determinant [+]1",
    ),
    "mask of numbers": (_set("mask", np.full((12, 2, 3), 2)), "mask: expected True and False"),
    "position error nan": (
        _set("position_std", np.array([0.1] * 11 + [np.nan])),
        "position_std, row 11: expected a",
    ),
    "paths without offsets": (
        _set("path_gain", np.ones(4, complex)),
        "path_offsets: missing, but path_gain",
    ),
    "offsets fall": (_set("path_offsets", np.array([0, 2, 1] + [4] * 10)), "never decrease"),
    "offsets too short": (
        _together(_set("path_offsets", np.arange(13)), _set("path_direction", np.ones((11, 3)))),
        "expected 12 paths as path_offsets says, found",
    ),
    "zero direction": (
        _together(_set("path_offsets", np.arange(13)), _set("path_direction", np.zeros((12, 3)))),
        "path 0: expected a direction that is not zero",
    ),
    "split alone": (_set("split_train", np.arange(4)), "split_train is given alone"),
    "split twice": (
        _together(_set("split_train", np.array([1, 1])), _set("split_test", np.array([3]))),
        "split_train, row 1: named twice",
    ),
}


@pytest.mark.parametrize("case", CSI)
def test_own_csi(csi_arrays, refused, case):
    spoil, says = CSI[case]
    refused(says, from_arrays, spoil(csi_arrays))


SPECTRUM = {
    "negative power": (
        _entry("spectrum", (3, 0, 0), -0.1),
        r"spectrum, row 3: out of range.*is it in dB",
    ),
    "16 bit": (
        _set("spectrum", np.ones((10, 9, 36), np.uint16)),
        "expected uint8 or floating point",
    ),
    "flat": (_set("spectrum", np.ones((10, 324))), "spectrum: expected shape"),
    "grid past the zenith": (
        _set("grid_deg", np.array([20.0, 0, 10, 10])),
        "elevations run from 20 to 100",
    ),
    "grid past the circle": (_set("grid_deg", np.array([0.0, 0, 10, 11])), "exceed the circle"),
    "grid backwards": (_set("grid_deg", np.array([0.0, 0, -10, 10])), "steps positive"),
    "grid of two": (_set("grid_deg", np.array([0.0, 0])), "grid_deg: expected shape"),
    "turning receiver": (
        _set("rx_orientation", np.array([[1.0, 0, 0, 0]] * 9 + [[0, 1.0, 0, 0]])),
        "but turns",
    ),
}


@pytest.mark.parametrize("case", SPECTRUM)
def test_own_spectrum(spectrum_arrays, refused, case):
    spoil, says = SPECTRUM[case]
    refused(says, from_arrays, spoil(spectrum_arrays))


@pytest.mark.parametrize(
    ("attributes", "says"),
    [
        ({"normalisation": "maximum"}, "expected one of max, minmax"),
        ({"convergence_error": -1.0}, "at least 0"),
        ({"convergence_error": "low"}, "finite number"),
        (
            {"measurement": "spectra"},
            "'spectra' names no measurement of this file, which holds spectrum",
        ),
    ],
)
def test_attributes(spectrum_arrays, refused, attributes, says):
    refused(says, from_arrays, spectrum_arrays, attributes)


@pytest.mark.parametrize(
    ("powers", "says"),
    [
        ({"rssi_db": [-50, -60, 4000, -70.0]}, "row 2: out of range; expected dB"),
        ({"rssi": [-50, -60, -70, -70.0]}, "linear power"),
        ({"rssi_db": [-50, -60, -40, -70.0], "noise_variance": 1.0}, "cannot go with rssi_db"),
    ],
)
def test_powers_beyond_reason(refused, powers, says):
    rows = {"rx_position": np.arange(12.0).reshape(4, 3), "tx_position": np.zeros(3)}
    refused(says, from_arrays, rows | {name: np.array(value) for name, value in powers.items()})


def _archive(arrays) -> bytes:
    stored = io.BytesIO()
    np.savez(stored, **arrays)
    return stored.getvalue()


def _encrypted(whole: bytes) -> bytes:
    content = bytearray(whole)
    content[content.rindex(b"PK\x01\x02") + 8] |= 1  # the flag in the last entry of the directory
    return bytes(content)


def _array_twice(whole: bytes) -> bytes:
    stored = io.BytesIO(whole)
    with zipfile.ZipFile(stored, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python warns of the name
        archive.writestr("csi.npy", archive.read("csi.npy"))
    return stored.getvalue()


NO_FILES = {  # name of the file, what becomes of a sound archive, and what is said
    "absent.npz": (None, "no such file"),
    "mine.csv": (lambda whole: b"x", r"expected .* \.hdf5, \.nc, \.nc3, \.nc4, \.cdf; found \.csv"),
    "empty.hdf5": (lambda whole: b"", "damaged or not an HDF5"),
    "locked.npz": (_encrypted, "damaged or not an npz file.*encrypted"),
    "twice.npz": (_array_twice, "csi: damaged .*twice"),
    "objects.npz": (
        lambda whole: _archive({"csi": np.array([{"a": 1}], dtype=object)}),
        "holds Python objects",
    ),
}


@pytest.mark.parametrize("name", NO_FILES)
def test_files_that_are_no_files(tmp_path, csi_arrays, refused, name):
    change, says = NO_FILES[name]
    if change is not None:
        (tmp_path / name).write_bytes(change(_archive(csi_arrays)))
    refused(says, load_own, tmp_path / name)


def test_a_name_that_cannot_be_written_is_said_with_those_that_can(tmp_path, csi_arrays, refused):
    refused(
        r"cannot be written as '\.mat'; name it \*\.npz, ",
        write_own,
        tmp_path / "mine.mat",
        csi_arrays,
    )


def test_a_file_that_cannot_be_opened_is_a_line(tmp_path, csi_arrays, refused, monkeypatch):
    """The reason is the system's, not a traceback, and not "damaged"."""
    np.savez(tmp_path / "a.npz", **csi_arrays)

    def refuse(*unused, **more):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    refused(r"a\.npz: cannot be read .*Permission denied", load_own, tmp_path / "a.npz")


@pytest.mark.parametrize(
    "text,says",
    [
        ("[" * 50_000, "brackets within brackets, too many"),
        ('{"name": ' + "[" * 50_000, "brackets within brackets, too many"),
        ('{"a": ' + "1" * 5000 + "}", r"Exceeds the limit .* value has 5000 digits\)$"),
        ("[1]", "expected a JSON table as text .found a list"),
        ("{", "expected a JSON table"),
        ('{"units": {"frequency_hz": "GHz"}}', "frequency_hz: units are 'GHz'; expected 'Hz'"),
        ('{"units": [1]}', "units is no table"),
        ('{"name": [1]}', "name: a list; expected text"),
        ('{"stand_in": 5}', "stand_in: a int; expected text"),
        ('{"convergence_error": true}', "convergence_error: True; expected a finite number"),
    ],
)
def test_attributes_that_are_none(tmp_path, csi_arrays, refused, text, says):
    """Brackets ended `gsparc check` in a traceback; lists and truth values passed."""
    np.savez(tmp_path / "own.npz", attributes=np.array(text), **csi_arrays)
    said = str(refused(says, load_own, tmp_path / "own.npz"))
    assert "own.npz, " in said and "set_int_max_str_digits" not in said


HOLLOW = {
    "a.json": "[" + "{}," * 10**6 + "{}]",
    "b.json": "[{" + "[" * 2**21,
    "c.json": "{}\n" * 10**6,
    "d.json": "<a>" * 10**6,
    "e.csv": "\n" * 2**21,
    "f.csv": "#\r\n" * 10**6,
    "g.csv": ",,\n" * 10**6,
    "h.json": '{"a": [1, 2], "b": [' + "1," * 10**6 + "1]}",
}


@pytest.mark.parametrize("name", HOLLOW)
def test_files_of_nothing_but_brackets_or_lines_took_minutes(tmp_path, name):
    """60 MB of brackets took 27 s, blank lines of a gz file did not end:
    by a character's count now.
    """
    (tmp_path / name).write_text(HOLLOW[name])
    began = time.process_time()
    with pytest.raises(DataError, match=r"nearly nothing but|more than 10,000 values") as refused:
        read_any(tmp_path / name)
    assert time.process_time() - began < 2 and len(refused.value.problems) == 1
