"""Tables and arrays as strangers make them: each kind is read right, or named."""

import h5py
import numpy as np
import pytest
from doors import said
from scipy.io import savemat
from strangers import (
    CASES,
    DEAF,
    EAST,
    LEVELS,
    NORTH,
    ONE_CELL,
    PLACES,
    RNG,
    ROWS,
    ZONES,
    long,
    table,
    wide,
)

from gsparc.commands.check import main
from gsparc.datasets.own import Own, read_any
from gsparc.tables.own import write_own
from gsparc.tables.query_places import read_query_places


@pytest.mark.parametrize("name", CASES)
def test_a_table_of_a_stranger(write, name):
    content, settings, says, silent = CASES[name]
    found = said(write(content), **settings)
    assert says in found and (not silent or silent not in found), found


@pytest.mark.parametrize("name", ONE_CELL)
@pytest.mark.parametrize("head", ["spot", "gps"])
def test_a_place_in_one_cell_was_no_place(write, name, head):
    data = read_any(write(table(f"{head},rssi", ONE_CELL[name], LEVELS[:, 0]))).data
    at = data.site.georeference.from_degrees(NORTH.round(6), EAST.round(6))
    np.testing.assert_allclose(data.moving[:, :2] + data.site.origin[:2], at, atol=1e-6)


def test_places_to_predict_may_stand_in_one_cell(write):
    path = write(table("n,spot", range(ROWS), ONE_CELL["well-known text"]))
    places = read_query_places(path, ["rx"])
    np.testing.assert_allclose(places.ends["rx"].across, np.c_[NORTH, EAST], atol=1e-6)


@pytest.mark.parametrize(
    "cell", ['"POINT (16,37 48,2)"', '"{""coordinates"": [[[1, 2], [3, 4]]]}"', "{16.37: [}"]
)
def test_a_cell_that_is_no_place_is_refused_in_a_line(write, cell):
    assert "no coordinates among 'geometry'" in said(
        write(table("geometry,rssi", [cell] * ROWS, LEVELS[:, 0]))
    )


def test_what_is_silent_is_learned_as_such_and_what_is_not_is_not(write):
    data = read_any(write(wide(100))).data
    assert data.censored.sum() == 394 and (data.censored == DEAF.ravel()).all()
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    assert abs(level[data.censored == 0].min() - LEVELS[~DEAF].min()) < 1e-3  # of float32


def test_saturated_levels_were_learned_and_scored_as_measured(write):
    path = write(long("t", range(ROWS), level=np.minimum(LEVELS[:, 0], -76)))
    found, plain, given = (
        read_any(path, saturation_db=one).data for one in ("auto", "none", -79.5)
    )
    level = 10 * np.log10(found.target[:, 0] * found.site.target_scale)
    assert plain.censored is None and plain.mask is None
    for data, least in ((found, -76), (given, -79.5)):
        above = LEVELS[:, 0] >= least
        assert (data.censored == np.where(above, -1, 0)).all() and (data.mask[:, 0] == ~above).all()
    np.testing.assert_allclose(level, np.minimum(LEVELS[:, 0], -76), atol=1e-3)


def channels() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    csi = rng.normal(size=(30, 4)) + 1j * rng.normal(size=(30, 4))
    return {
        "rx_position": rng.uniform(0, 9, (30, 3)),
        "tx_position": np.array([4.0, 2, 2]),
        "csi": csi,
        "frequency_hz": 2.4e9 + np.arange(4) * 1e6,
    }


@pytest.mark.parametrize("names", [("real", "imag"), ("r", "i")])
def test_compounds_of_real_and_imaginary_parts_were_refused(tmp_path, names):
    arrays, wanted = channels(), write_own(tmp_path / "a.npz", channels())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, array in arrays.items():
            parts = array
            if name == "csi":
                parts = np.zeros(array.shape, [(part, "f8") for part in names])
                parts[names[0]], parts[names[1]] = array.real, array.imag
            file[name] = parts
    np.testing.assert_array_equal(read_any(tmp_path / "a.h5").data.target, wanted.target)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_files_of_matlab_were_refused(tmp_path, version):
    arrays, wanted, path = channels(), write_own(tmp_path / "a.npz", channels()), tmp_path / "a.mat"
    if version == "5":
        savemat(path, {**arrays, "name": "hall"})
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, array in arrays.items():
                file[name] = np.atleast_2d(array).T
            file["name"] = np.array([[ord(letter)] for letter in "hall"], np.uint16)
            file["name"].attrs["MATLAB_class"] = np.bytes_("char")
    data = read_any(path).data
    np.testing.assert_array_equal(data.target, wanted.target)
    assert data.site.name == "hall"


@pytest.mark.parametrize("unit", ["deg", "rad", ""])
def test_amplitudes_and_phases_are_channels(write, unit):
    arrays = channels()
    phase = np.angle(arrays["csi"]) * (1 if unit != "deg" else 180 / np.pi)
    heads = [f"csi_amp_{k},csi_phase_{k}{'_' if unit else ''}{unit}" for k in range(4)]
    columns = np.stack([np.abs(arrays["csi"]), phase], axis=2).reshape(30, 8)
    text = table(",".join(["x,y,z", *heads]), *arrays["rx_position"].T, *columns.T)
    where = {"tx_x": 4, "tx_y": 2, "tx_z": 2, "frequency_hz": "2.4e9:2.403e9"}
    data = read_any(write(text), columns=where).data
    np.testing.assert_allclose(data.target[:, 0] * data.site.target_scale, arrays["csi"], atol=1e-5)


def test_places_and_tones_that_a_file_lacks_can_be_said(write, capsys):
    rng, rx = np.random.default_rng(0), PLACES / 10
    heads = ",".join(f"csi_amp_{k},csi_phase_{k}" for k in range(4))
    path = write(table(f"x,y,z,{heads}", *rx.T, [1.5] * ROWS, *rng.uniform(0, 1, (8, ROWS))))
    assert (
        "tx_position: missing; expected (3,), (S, 3), (2,) or (S, 2) [m]; or say dataset.tx"
    ) in said(path)
    given = [
        "dataset.tx_position=[5,3,1.5]",
        "dataset.frequency_hz=[2.4e9,2.401e9,2.402e9,2.403e9]",
    ]
    assert main([str(path), *given, "--no-draw"]) == 0
    assert "1 antenna x 4 subcarriers" in capsys.readouterr().out


def test_groups_of_places_were_said_twice(write, caplog):
    Own(write(long("grid", np.where(np.arange(ROWS) < 80, "32T", "33T"), places=ZONES))).load()
    assert sum("groups of places" in record.getMessage() for record in caplog.records) == 1


def test_a_mark_beside_strong_levels_was_a_saturation_or_not_heard(write):
    """Android's -1 and a computer's largest number are no value;
    beside weak levels alone not heard.
    """
    some = RNG.random(LEVELS.shape) < 0.1
    for mark in (-1, 2147483647, -32768):
        cells = np.where(some, mark, LEVELS.astype(int)).astype(str)
        path = write(table("x,y,AP1,AP2,AP3", *PLACES.T, *cells.T))
        found, data = said(path), read_any(path).data
        assert "as well as weak ones: no value, left out" in found and data.censored is None, found
        assert len(data) == (~some).sum()


def test_levels_in_hundredths_of_a_decibel_were_refused_row_by_row(write):
    path = write(table("x,y,PeakRSSI", *PLACES.T, LEVELS[:, 0] * 100))
    assert "in parts of a dB? say dataset.columns.rssi_db=PeakRSSI*0.01" in said(
        path, columns={"rssi_db": "PeakRSSI"}
    )
