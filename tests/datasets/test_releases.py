"""Files as their makers published them, beside what was converted from them."""

import pickle
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from releases import real, write_release

from gsparc.base.errors import DataError
from gsparc.base.pickles import FRAMES, read_pickle
from gsparc.datasets.ble import read_ble
from gsparc.datasets.load import load
from gsparc.datasets.newrf import read_newrf
from gsparc.datasets.own import read_any
from gsparc.datasets.rfid import load_rfid
from gsparc.datasets.techtile_power import read_techtile_power

ROOM = "releases/newrf/dataset_conference_ch1_rt_image_fc.pkl"


def test_newrf_room_is_what_was_converted_from_it():
    released, converted = (
        read_newrf(real(ROOM)).arrays,
        read_newrf(real("newrf-conference.npz")).arrays,
    )
    assert len(released["csi"]) == 433
    for name in set(converted) - {"split_train", "split_test"}:
        assert np.abs(released[name].astype(complex) - converted[name]).max() <= 1e-6, name
    assert load({"name": "newrf", "file": str(real(ROOM))}).site.kind == "csi"
    assert "dataset=newrf" in read_any(real(ROOM)).notes[0]


def frame(rows: int = 8, **changed):
    """A room of NeWRF's table, with the pandas that is installed."""
    import pandas

    rng = np.random.default_rng(0)
    columns = {
        "TxPos": [np.array([-1.5, 0, 1.7])] * rows,
        "RxPos": [*rng.uniform(0, 3, (rows, 3))],
        "CSI": [*(rng.normal(size=(rows, 1)) + 1j)],
        "Frequency": [2.412] * rows,
        "LastXPts": [rng.normal(size=(3, 4)) for _ in range(rows)],
        "RxChanPerRay": [rng.normal(size=(4, 1)) + 0j for _ in range(rows)],
        "LineOfSight": np.ones(rows, np.uint8),
        **changed,
    }
    heads = pandas.Index(list(columns), dtype=object)
    return pandas.DataFrame({name: pandas.Series(columns[name]) for name in heads}).set_axis(
        heads, axis=1
    )


class Runs:
    def __reduce__(self):
        return Path.touch, (Path("ran"),)


class Asks:
    def __init__(self, name):
        self.name = name

    def __reduce__(self):
        return eval, (self.name,)


ALTERS_FUNCTIONS = (
    b"cnumpy.core.numeric\n_frombuffer\n(NS'__name__'\nS'mine'\nsdtb."  # BUILD on what is looked up
)
SPOILT = {
    "code": (
        pickle.dumps(Runs()),
        r"asks for pathlib\.Path.*, which is neither an array nor a part of a table: not run",
    ),
    "code in a column": (
        pickle.dumps([np.ones(3), Asks("open('ran', 'w')")]),
        r"asks for builtins\.eval",
    ),
    "system": (b"cos\nsystem\n(S'touch ran'\ntR.", r"asks for posix\.system|asks for os\.system"),
    "a dotted name": (
        b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.data\x93.",
        r"asks for numpy\.ndarray\.data",
    ),
    "a function's name": (ALTERS_FUNCTIONS, "damaged, or no pickle of arrays"),
    "cut short": (pickle.dumps(np.arange(9.0))[:-20], "damaged, or no pickle of arrays"),
    "an array": (pickle.dumps(np.ones(3)), "no pickled pandas table"),
    "a recursion": (b"(" * 100_000 + b".", "damaged|no pickle"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_pickle_runs_nothing(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    content, says = SPOILT[case]
    (tmp_path / "room.pkl").write_bytes(content)
    with pytest.raises(DataError, match=says) as error:
        read_newrf(tmp_path / "room.pkl")
    assert not (tmp_path / "ran").exists() and str(error.value).startswith(f"{tmp_path}/room.pkl: ")


@pytest.mark.parametrize("protocol", range(6))
def test_pickled_arrays_of_every_protocol(tmp_path, protocol):
    held = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.array([np.ones(2), "x", None], object),
        "c": np.float32(2),
    }
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(held, protocol))
    found = read_pickle(tmp_path / "x.pkl", FRAMES)
    assert np.array_equal(found["a"], held["a"]) and found["c"] == 2 and found["b"][1] == "x"


def test_newrf_tables_without_a_column_or_of_two_rooms(tmp_path, refused):
    frame().drop(columns="CSI").to_pickle(tmp_path / "a.pkl")
    refused("no columns CSI; it holds TxPos", read_newrf, tmp_path / "a.pkl")
    frame(Frequency=[2.4, 5.8] * 4).to_pickle(tmp_path / "b.pkl")
    refused("several transmitters or frequencies", read_newrf, tmp_path / "b.pkl")
    frame(LastXPts=[np.ones((2, 4))] * 8).to_pickle(tmp_path / "c.pkl")
    refused(
        "path_last_point|not the table of a room",
        lambda p: load({"name": "newrf", "file": str(p)}),
        tmp_path / "c.pkl",
    )


def test_ble_folder_is_what_was_converted_from_it():
    released, converted = (
        read_ble(real(n)).arrays for n in ("releases/ble-hall", "real/ble-hall-1.npz")
    )
    assert released["rssi_db"].shape == (7, 12)
    assert np.array_equal(released["station_position"], converted["station_position"])
    assert released["station_name"].tolist() == converted["station_name"].tolist()
    rows = [
        np.flatnonzero((converted["tx_position"] == place).all(1))
        for place in released["tx_position"]
    ]
    assert all(len(row) == 1 for row in rows)
    # The first 25 packets of thousands: their means scatter by the fading of one.
    apart = released["rssi_db"] - converted["rssi_db"][np.concatenate(rows)]
    assert np.sqrt(np.mean(apart**2)) < 3 and abs(apart.mean()) < 1
    assert released["rssi_db"].sum() == pytest.approx(-6424.52, abs=0.01)
    assert "dataset=ble" in read_any(real("releases/ble-hall")).notes[0]


DEVICES = (
    'Dongles:{"aa": [[7.0, 7.09, 1.22], 1, "sensor10"], "bb": [[7.18, 0.68, 2.3], 2, '
    '"sensor11"] }\nBeacons:{}\n'
)


def hall(root: Path) -> Path:
    (root / "cnf").mkdir(parents=True)
    (root / "cnf/tetam.dev").write_text(DEVICES)
    for number in (1, 2):
        (root / f"hst/set_{number}").mkdir(parents=True)
        for name in ("sensor10", "sensor11"):
            for place in ("10.5_2.0_1.85", "9.5_-2.0_1.85"):
                packets = "".join(f"15.{i},aa,e7,{-60 - i - number}\n" for i in range(3))
                (root / f"hst/set_{number}/{name}_{place}.mbd").write_text(packets)
    (root / "hst/set_1/sensor11_10.5_2.0_1.85.mbd").unlink()
    return root


BLE = {
    "no sensors": ("cnf/tetam.dev", None, "tetam.dev: missing; expected a first line Dongles:"),
    "other devices": (
        "cnf/tetam.dev",
        "Dongles:{'a': 1}",
        "tetam.dev, line 1: expected a first line",
    ),
    "place of two": (
        "cnf/tetam.dev",
        DEVICES.replace("7.09, 1.22", "7.09"),
        "line 1: expected a first line",
    ),
    "a word": (
        "hst/set_1/sensor10_10.5_2.0_1.85.mbd",
        "1,aa,e7,loud\n",
        "expected lines of time, sensor, beacon and dBm",
    ),
    "three cells": ("hst/set_1/sensor10_10.5_2.0_1.85.mbd", "1,aa,-5\n", "expected lines of time"),
    "other sensor": (
        "hst/set_1/sensor99_1_2_3.mbd",
        "1,aa,e7,-5\n",
        "no sensor of cnf/tetam.dev is called 'sensor99'",
    ),
    "place in the name": (
        "hst/set_1/sensor10_1_2.mbd",
        "1,aa,e7,-5\n",
        "expected a name like sensor10_X_Y_Z.mbd",
    ),
}


@pytest.mark.parametrize("case", BLE)
def test_spoilt_ble_folders(tmp_path, refused, case):
    name, text, says = BLE[case]
    file = hall(tmp_path / "hall") / name
    file.unlink(missing_ok=True)
    if text is not None:
        file.write_text(text)
    refused(says, read_ble, tmp_path / "hall")
    refused("no \\*.mbd files", read_ble, hall(tmp_path / "other"), 3)


class PositionerValue:
    def __init__(self, x, y, z):
        self.t, self.x, self.y, self.z, self.rotation_matrix = "now", x, y, z, None


class ep_data:
    def __init__(self, power):
        self.timestamp, self.buffer_voltage_mv, self.resistance, self.pwr_pw = 1, 1200, 700, power


def plane(folder: Path, places, powers, module="Positioner") -> Path:
    """A run as the makers' recorder stores it, with classes of the names they have there."""
    folder.mkdir()
    names = {PositionerValue: module, ep_data: "lib.ep"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "lib", ModuleType("lib"))
        for kind, name in names.items():
            patch.setattr(kind, "__module__", name)
            patch.setitem(sys.modules, name, SimpleNamespace(**{kind.__name__: kind}))
        np.save(
            folder / "17_positions.npy", np.array([PositionerValue(*place) for place in places])
        )
        np.save(folder / "17_values.npy", np.array([ep_data(power) for power in powers]))
    return folder


def test_techtile_power_of_pickled_objects(tmp_path, caplog):
    folder = plane(tmp_path / "RECI-RF-1", np.eye(4, 3) + 3, [58_600_000.0, 1e6, 1e9, 0])
    arrays = read_techtile_power(folder).arrays
    # Of 58.6, 1 and 1,000 microwatts
    assert np.allclose(arrays["rssi_db"], [-12.321, -30, 0], atol=1e-3)
    assert np.array_equal(arrays["rx_position"], np.float32(np.eye(3) + 3))
    assert arrays["frequency_hz"] == 920e6
    assert (
        "dataset=techtile_power"
        in read_any(plane(tmp_path / "b", np.random.rand(20, 3), [1e6] * 20)).notes[0]
    )


def test_techtile_power_of_other_objects(tmp_path, refused):
    other = plane(tmp_path / "a", np.eye(3), [1.0] * 3, module="elsewhere")
    refused(r"17_positions.npy: .*asks for elsewhere\.PositionerValue", read_techtile_power, other)
    longer = plane(tmp_path / "b", np.eye(3), [1.0] * 2)
    refused("3 positions, but 2 values", read_techtile_power, longer)
    (longer / "17_values.npy").unlink()
    refused("17_values.npy: no such file", read_techtile_power, longer)
    refused("expected one \\*_positions.npy", read_techtile_power, tmp_path)


def test_rfid_list_of_our_tables_is_out_of_the_200(tmp_path):
    """Of the 200 only the 160 are here: where the others would lie, copies stand for them."""
    import csv
    from importlib.resources import files
    from shutil import copy

    root = real("rfid-s23-160")
    ours = load_rfid(root)
    rows = list(
        csv.DictReader(
            files("gsparc.datasets.public").joinpath("rfid-160.csv").read_text().splitlines()
        )
    )
    (tmp_path / "spectrum").mkdir()
    number = {int(row["spectrum"]): i + 1 for i, row in enumerate(rows)}
    lines = (root / "tx_pos.csv").read_text().splitlines()
    for i in range(1, 201):
        copy(root / f"spectrum/{number.get(i, 1):05d}.png", tmp_path / f"spectrum/{i:05d}.png")
    (tmp_path / "tx_pos.csv").write_text(
        "\n".join(["x,y,z", *(lines[number.get(i, 1)] for i in range(1, 201))])
    )
    copy(root / "gateway_info.yml", tmp_path)
    listed = load({"name": "rfid", "root": str(tmp_path), "listed": 160})
    assert np.array_equal(listed.target, ours.target) and np.array_equal(listed.moving, ours.moving)
    assert all(map(np.array_equal, listed.release_split, ours.release_split))


def test_rfid_lists(tmp_path, refused):
    root = write_release(tmp_path / "rfid")
    (tmp_path / "list.csv").write_text("spectrum,split\n00002,train\n5,test\n00003,train\n")
    data = load_rfid(root, listed=tmp_path / "list.csv")
    assert len(data) == 3 and data.row_names[1] == "spectrum/00005.png"
    assert [rows.tolist() for rows in data.release_split] == [[0, 2], [1]]
    (tmp_path / "list.csv").write_text("spectrum,split\n00002,train\n7,test\n3,maybe\n")
    refused(
        "list.csv, column 'spectrum', line 3: expected the number of a spectrum, 1 to 6",
        lambda p: load_rfid(p, listed=tmp_path / "list.csv"),
        root,
    )
    refused("no.csv: no such file", lambda p: load_rfid(p, listed=tmp_path / "no.csv"), root)
