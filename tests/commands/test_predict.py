"""From a table of places to a table of predictions, in degrees and in metres."""

import csv
import logging
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from doors import knock
from drives import write_table
from refusals import refused_as

import gsparc
from gsparc.apps.maps.promise import Promise
from gsparc.base.errors import DataError
from gsparc.commands.listing import COMMANDS
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.answer_files import predict_file
from gsparc.prediction.left_out import HeldOutLevels
from gsparc.runs.align_site import align_to_site
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

refused = partial(refused_as, DataError)

POSTS = np.array([[0.0, 0, 5], [20, 0, 5], [0, 20, 5]])
NAMES = np.array(["roof-0", "roof-1", "mast"])


def fitted(arrays, folder, name="gp", skip=()):
    """A model of arrays of the schema, stored and loaded; rows `skip` are not learned from."""
    data = from_arrays(arrays)
    rows = np.setdiff1d(np.arange(len(data)), skip)
    method = wrap_per_station(method_class(name)(), data)
    method.fit(data, Fold(rows, rows[:0], rows[:5]), FitContext(folder))
    checkpoint.save(folder / "model.ckpt", method)
    return gsparc.load(folder / "model.ckpt")


def walk(count=60, low=0.0, high=20.0):
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.full(count, 1.5)])


def powers(places):
    return -20 * np.log10(np.linalg.norm(places[:, None] - POSTS, axis=-1)) - [0, 10, 20]


def stations(**changes):
    """Arrays of three stations that transmit, in metres; the receiver is 1.5 m above ground."""
    arrays = {"rx_position": walk(), "station_position": POSTS, "station_name": NAMES}
    return {**arrays, "rssi_db": powers(walk()), **changes}


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return fitted(stations(), tmp_path_factory.mktemp("town"))


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    """One station, in degrees; the receiver's height differs."""
    rng = np.random.default_rng(0)
    latitude, longitude = 47 + rng.uniform(0, 0.01, 60), 11 + rng.uniform(0, 0.01, 60)
    arrays = {
        "latitude": latitude,
        "longitude": longitude,
        "rx_height": rng.uniform(1, 3, 60),
        "station_latitude": np.array([47.005]),
        "station_longitude": np.array([11.005]),
        "station_height": np.array(30.0),
        "rssi_db": -60 - 1000 * np.abs(latitude[:, None] - 47.005),
    }
    return fitted(arrays, tmp_path_factory.mktemp("valley"))


def read(path):
    with Path(path).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


def answered(model, folder, heads, rows, **how):
    """Rows of the table of predictions at the rows of a table."""
    rows = rows.tolist() if isinstance(rows, np.ndarray) else rows
    count = len(list(folder.glob("*.csv")))
    return read(
        predict_file(model, write_table(folder / f"{count}.csv", heads, rows), **how)["out"]
    )


def test_a_station_was_not_found_by_its_name_in_the_list_of_cells(town, tmp_path, monkeypatch):
    place = [[5, 5, 1.5]]
    (own,) = answered(town, tmp_path, ["x", "y", "z"], place, station="mast")
    monkeypatch.setitem(vars(town.site.stations), "label", ("A-1", "A-2", "B-1"))
    assert answered(town, tmp_path, ["x", "y", "z"], place, station="B-1") == [
        {**own, "cell": "B-1"}
    ]
    listed = answered(town, tmp_path, ["x", "y", "z", "station"], [[*place[0], "B-1"]])
    assert [row["rssi_db"] for row in listed] == [own["rssi_db"]]
    assert town.select_station("B-1").site.static_position is not None


@pytest.mark.parametrize("labels", [None, ("A-1", "A-2", "B-1")])
def test_columns_of_predictions_changed_with_those_of_places(town, tmp_path, monkeypatch, labels):
    """A column `cell` came back as `station`, with the model's names in it,
    and one of any other head replaced it.
    """
    monkeypatch.setitem(vars(town.site.stations), "label", labels)
    (plain,) = answered(town, tmp_path, ["x", "y", "z"], [[5, 5, 1.5]], station="mast")
    for head in ("station", "cell", "PCI"):
        (row,) = answered(town, tmp_path, ["x", "y", "z", head], [[5, 5, 1.5, "mast"]])
        assert {*row} == {*plain, head} and row["station"] == plain["station"]
        assert [*row][:4] == ["x", "y", "z", head] and row[head] == "mast"


def test_coordinates_were_written_anew_under_other_heads(valley, tmp_path):
    """Latitude came back as latitude, 47.003000 as 47.003."""
    (row,) = answered(
        valley, tmp_path, ["Longitude", "Latitude", "Height"], [["11.0010", "47.003000", "2.0"]]
    )
    assert [*row.items()][:3] == [
        ("Longitude", "11.0010"),
        ("Latitude", "47.003000"),
        ("Height", "2.0"),
    ]
    assert [*row][3:5] == ["station", "rssi_db"]


def test_every_station_of_every_place(town, tmp_path):
    place = walk()[:7] + np.array([0.5, 0, 0])
    facts = predict_file(town, write_table(tmp_path / "a.csv", "xyz", place.tolist()))
    found = read(facts["out"])
    assert [row["station"] for row in found] == NAMES.tolist() * 7
    assert column(found, "x").tolist() == np.repeat(place[:, 0], 3).tolist()
    level = column(found, "rssi_db").reshape(-1, 3)
    assert np.abs(level - powers(place)).max() < 6
    for number, name in enumerate(NAMES):
        expected = town.select_station(str(name)).rssi(rx=place)[:, 0]
        assert np.allclose(level[:, number], expected, atol=1e-4)
    assert facts["predict/predictions"] == 21 and facts["predict/far_outside"] == 0


def test_rows_about_one_station_each_and_about_one_only(town, tmp_path):
    heads = ["x", "y", "z", "cell"]
    table = [[5, 5, 1.5, "mast"], [6, 6, 1.5, "roof-1"], [7, 7, 1.5, "mast"], [8, 8, 1.5, "roof-0"]]
    found = answered(town, tmp_path, heads, table)
    assert [row["cell"] for row in found] == ["mast", "roof-1", "mast", "roof-0"]
    assert column(answered(town, tmp_path, heads, table, station="mast"), "x").tolist() == [5, 7]
    places = [row[:3] for row in table]
    one = answered(town, tmp_path, "xyz", places, station="roof-1")
    assert {row["station"] for row in one} == {"roof-1"}
    with pytest.raises(DataError, match=r"line 4: 'roof-2' is no station.*did you mean 'roof-"):
        answered(town, tmp_path, heads, [*table[:2], [1, 1, 1, "roof-2"]])
    with pytest.raises(DataError, match=r"station=mats: no such station; did you mean 'mast'"):
        answered(town, tmp_path, "xyz", places, station="mats")
    refused(
        r"no row of .*\.csv is about it",
        answered,
        town,
        tmp_path,
        heads,
        table[:1],
        station="roof-0",
    )


def test_stations_called_by_numbers_answered_for_each_other(tmp_path):
    """They were asked by their index, which is the name of another."""
    model = fitted(stations(station_name=np.array(["1", "2", "3"])), tmp_path)
    found = column(answered(model, tmp_path, "xyz", walk()[:4]), "rssi_db").reshape(4, 3)
    assert np.abs(found - powers(walk())[:4]).max() < 0.1


@pytest.mark.parametrize(("names", "asked"), [(NAMES.tolist(), "0"), (["212", "33", "7"], "1")])
def test_a_number_that_names_no_station_was_an_index(tmp_path, names, asked):
    """`0` in a table of places answered as `roof-0`,
    and an unknown cell id below T as another cell.
    """
    model = fitted(stations(station_name=np.array(names)), tmp_path)
    rows = [[5, 5, 1.5, names[0]], [8, 8, 1.5, asked]]
    with pytest.raises(DataError, match=f"line 3: '{asked}' is no station of the model"):
        answered(model, tmp_path, ["x", "y", "z", "cell"], rows)
    # Names that are numbers leave none for counting, from Python and in settings too
    if "mast" not in names:
        with pytest.raises(ValueError, match="no station 1; there are 212, 33, 7"):
            model.select_station(1)


def test_stations_at_unknown_places(tmp_path):
    """They are told apart by their names; what needs their places, together, says so."""
    posts = np.where([[True], [False], [False]], POSTS, np.nan)
    arrays = stations(station_position=posts)
    model = fitted(arrays, tmp_path, "distance_law")
    found = column(answered(model, tmp_path, "xyz", walk()[:4]), "rssi_db").reshape(4, 3)
    assert np.abs(found - powers(walk())[:4]).max() < 1
    turned = {"station_position": posts, "station_name": NAMES, "rssi_db": arrays["rssi_db"].T}
    back = stations(**{name: values[::-1] for name, values in turned.items()})
    same = align_to_site(from_arrays(back | {"rssi_db": back["rssi_db"].T}), model.site)
    assert [NAMES[t] for t in same.station[:3]] == ["mast", "roof-1", "roof-0"]
    data = from_arrays(arrays)
    rows = np.arange(len(data))
    method = wrap_per_station(method_class("gp")(), data)
    with pytest.raises(
        ValueError, match="places of stations are unknown, it needs them; say stations=each"
    ):
        method.fit(data, Fold(rows, rows[:0], rows[:5]), FitContext(tmp_path, stations="together"))
    heard, name = rows[data.station[rows] != 1], data.site.stations.name[1]
    with pytest.raises(ValueError, match=rf"for those without training rows \({name}\)"):
        # It said `say stations=each` here too.
        method.fit(data, Fold(heard, rows[:0], rows), FitContext(tmp_path, stations="each"))


def test_a_height_that_is_not_given(town, valley, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    found = answered(town, tmp_path, "xy", [[5, 5], [6, 6]])
    assert "no height of the receiver: taken as 1.5 m" in caplog.text
    assert column(found, "z").tolist() == [1.5] * 6
    hill = ["lat", "lon"], [[47.003, 11.004]]
    with pytest.raises(
        DataError, match=r"measured at heights from 1\.\d+ to 2\.\d+ m; say columns.height="
    ):
        answered(valley, tmp_path, *hill)
    assert answered(valley, tmp_path, *hill, columns={"height": 2.0})[0]["height"] == "2.0"


def test_watts_were_answered_in_decibels(tmp_path):
    arrays = {
        "tx_position": walk(),
        "rx_position": POSTS[0],
        "rssi": 10 ** (powers(walk())[:, 0] / 10),
    }
    fitted(arrays, tmp_path)
    file, level = write_table(tmp_path / "a.csv", "xyz", walk()[:4].tolist()), powers(walk())[:4, 0]
    watts = 10 ** (level / 10)
    heads = {None: ("rssi_W", watts), "mW": ("rssi_mW", 1e3 * watts)}
    heads |= {"dBm": ("rssi_db", level + 30), "dBW": ("rssi_db", level)}
    for unit, (head, wanted) in heads.items():
        facts = predict_file(gsparc.load(tmp_path / "model.ckpt", unit=unit), file, overwrite=True)
        found = read(facts["out"])
        assert list(found[0])[3:] == [head, f"{head}_std", "confidence"]
        assert facts["predict/unit"] == (unit or "W")
        assert facts[f"predict/highest_{head[5:]}"] == pytest.approx(column(found, head).max())
        assert np.allclose(
            column(found, head), wanted, atol=1 if head == "rssi_db" else 0, rtol=0.2
        )
    settings = [f"ckpt={tmp_path / 'model.ckpt'}", f"places={file}", "overwrite=true", "unit=dBm"]
    done = knock(COMMANDS["predict"].run, "predict", [*settings, f"hydra.run.dir={tmp_path}"])
    assert done.status == 0 and any(" dBm; predictions in" in line for line in done.out), done


BAD_TABLES = {
    "latitude 95": (
        "lat,lon,height\n47,11,2\n95,11,2\n",
        r"line 3: latitude 95 is outside -90 to 90",
    ),
    "no value": ("lat,lon,height\n47,,2\n", r"column 'lon', line 2: no value"),
    "no coordinates": (
        "time,speed\n1,2\n",
        r"no coordinates of the receiver among 'time', 'speed'; say columns\.lat",
    ),
    "half": ("lat,height\n47,2\n", r"and none is longitude; say columns\.lon=COLUMN"),
    "far": ("x,y,z\n1,1,2\n2e7,0,2\n", r"line 3: \(2e\+07, 0, 2\) is more than 10000 km"),
    "another end": ("tx_lat,tx_lon\n47,11\n", r"no coordinates of the receiver"),
    "no station": ("lat,lon,height,cell\n47,11,2,\n", r"column 'cell', line 2: no station"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_tables_that_hold_no_places_are_refused(valley, tmp_path, name):
    text, said = BAD_TABLES[name]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=said) as raised:
        predict_file(valley, tmp_path / "a.csv")
    assert "\n" not in str(raised.value) and not (tmp_path / "a.predicted.csv").exists()


def test_where_the_answers_go(town, tmp_path):
    file = write_table(tmp_path / "a.csv", "xyz", [[5, 5, 1.5]])
    (tmp_path / "b.csv").write_text("kept")
    for out, how, message in (
        ("b.txt", {}, r"expected a name ending in \.csv or \.npz"),
        ("a.csv", {"overwrite": True}, "these are the places themselves"),
        ("b.csv", {}, "the file exists; say overwrite=true"),
    ):
        refused(message, predict_file, town, file, tmp_path / out, **how)
    assert (tmp_path / "b.csv").read_text() == "kept"
    predict_file(town, file, tmp_path / "b.csv", overwrite=True)
    assert len(read(tmp_path / "b.csv")) == 3
    predict_file(town, file, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as stored:
        assert stored["station"].tolist() == NAMES.tolist() and stored["rssi_db"].shape == (3,)
    refused(
        r"no rx_position or tx_position",
        predict_file,
        town,
        tmp_path / "b.npz",
        tmp_path / "c.csv",
    )
    refused("no such file", predict_file, town, tmp_path / "absent.csv")
    with pytest.raises(DataError, match="places in degrees, but arrays was measured in metres"):
        predict_file(town, write_table(tmp_path / "d.csv", ["lat", "lon"], [[47, 11]]))


def test_places_far_outside_are_counted(town, tmp_path, caplog):
    file = write_table(
        tmp_path / "a.csv", "xyz", [[5, 5, 1.5], [21, 5, 1.5], [5, 500, 1.5], [5, 5, 90]]
    )
    assert predict_file(town, file)["predict/far_outside"] == 2
    assert "2 of 4 places lie more than" in caplog.text and "the first in line 4" in caplog.text


def test_heights_above_the_sea_were_only_outside_the_box(town, tmp_path, caplog):
    file = write_table(tmp_path / "a.csv", "xyz", [[5, 5, 1615.5], [5, 7, 1612]])
    predict_file(town, file)
    assert "1,614 m above, only in height" in caplog.text


def test_columns_of_a_users_own_were_left_out_of_the_predictions(town, tmp_path):
    (tmp_path / "a.csv").write_text(
        "note,station,x,rssi_db,y,z\nwall,mast,1,-70,2,1.5\n,roof-0,3,,4,1.5\n"
    )
    predict_file(town, tmp_path / "a.csv")
    rows = read(tmp_path / "a.predicted.csv")
    heads = ["note", "station", "x", "rssi_db (given)", "y", "z", "rssi_db"]
    assert (
        list(rows[0])[:7] == heads
        and rows[0]["note"] == "wall"
        and rows[0]["rssi_db (given)"] == "-70"
    )


@pytest.mark.parametrize(("factor", "warned"), [(1e-3, True), (1e-5, True), (1e-2, False)])
def test_degrees_or_kilometres_as_metres_were_one_place_without_a_word(
    town, tmp_path, caplog, factor, warned
):
    """All of them lay within millimetres, in the middle of what was measured,
    and were predicted alike.
    """
    answered(
        town, tmp_path, "xyz", [[11 + x * factor, 4 + x * factor, 1 + x / 9] for x in range(19)]
    )
    assert ("degrees or km as x and y?" in caplog.text) == warned


@pytest.mark.parametrize(
    ("shape", "heads"), [((), ["csi_re", "csi_im"]), ((2, 3), ["csi_re_0_0", "csi_im_1_2"])]
)
def test_channels(tmp_path, shape, heads):
    rng = np.random.default_rng(0)
    channel = rng.normal(size=(60, *shape)) + 1j * rng.normal(size=(60, *shape))
    frequency = 2.4e9 + 1e6 * np.arange(shape[-1] if shape else 1)
    arrays = {
        "tx_position": walk(),
        "rx_position": POSTS[0],
        "csi": channel,
        "frequency_hz": frequency,
    }
    found = answered(fitted(arrays, tmp_path, "nearest"), tmp_path, "xyz", walk()[:3])
    assert set(heads) <= set(found[0])
    first = np.array([column(found, name) for name in found[0] if name.startswith("csi_re")]).T
    assert np.allclose(first, channel[:3].reshape(3, -1).real, rtol=1e-5)


TONES = {"frequency_hz": 2.4e9 + 1e6 * np.arange(5)}
UNTABLED = {
    "csi": (
        {"csi": np.ones((60, 4, 5), complex), **TONES},
        r"4 antennas x 5 subcarriers are more than 16 .*say out=FILE\.npz",
    ),
    "spectrum": (
        {"spectrum": np.random.default_rng(0).uniform(0, 1, (60, 12, 24))},
        r"spectra of 12 x 24 directions are no columns; say out=FILE\.npz",
    ),
}


@pytest.mark.parametrize("kind", UNTABLED)
def test_what_is_no_table_goes_to_an_npz(tmp_path, kind):
    arrays, message = UNTABLED[kind]
    model = fitted({"tx_position": walk(), "rx_position": POSTS[0], **arrays}, tmp_path, "mean")
    file = write_table(tmp_path / "a.csv", "xyz", walk()[:3].tolist())
    refused(message, predict_file, model, file)
    predict_file(model, file, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as stored:
        assert stored[kind].shape == (3, *arrays[kind].shape[1:])
        assert np.allclose(stored[kind], arrays[kind].mean(0), atol=1e-5)
        assert stored["x"].tolist() == walk()[:3, 0].tolist()


def test_both_ends_move(tmp_path):
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform(0, 20, (2, 80, 3))
    level = -20 * np.log10(np.linalg.norm(tx - rx, axis=1))
    model = fitted(
        {"tx_position": tx, "rx_position": rx, "rssi_db": level}, tmp_path, "distance_law"
    )
    heads, table = ["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"], np.hstack([tx, rx])[:4]
    found = answered(model, tmp_path, heads, table)
    assert list(found[0])[:6] == heads and np.abs(column(found, "rssi_db") - level[:4]).max() < 2
    plain = [*heads[:3], *"xyz"]  # of the two, the end without a name is the other one
    same = answered(model, tmp_path, plain, table)
    assert [row["rssi_db"] for row in same] == [row["rssi_db"] for row in found]
    for wrong, rows, message in (
        (
            heads[:3],
            table[:, :3],
            r"no coordinates of the receiver among .*say columns\.rx_x=COLUMN",
        ),
        ("xyz", table[:, :3], "no coordinates of the receiver"),
        (["tx_lat", "tx_lon", "tx_z", "rx_lat", "rx_lon", "rx_z"], table, "places in degrees, but"),
    ):
        refused(message, answered, model, tmp_path, wrong, rows)


def test_predict_answered_where_maps_refuse_and_its_deviations_held_79_of_90(tmp_path):
    """Errors twice the model's deviations on rows held out up to 5 m from the others."""
    rng, count = np.random.default_rng(0), 400
    town = fitted(stations(rssi_db=powers(walk()) + 2 * rng.normal(size=(60, 3))), tmp_path)
    own = np.full(count, 1.5)
    level, none, block = 2 * own * rng.normal(size=count), np.zeros(count), np.arange(count) // 4
    of = rng.integers(0, 3, count)
    evidence = HeldOutLevels(
        level, none, own, rng.uniform(0, 5, count), block, of, none.astype(np.int8)
    )
    known = np.repeat(walk() - town.site.origin, 3, 0)
    places = np.array([[10.0, 10, 1.5], [5, 15, 1.5], [10, 300, 1.5]])
    file = write_table(tmp_path / "asked.csv", "xyz", places.tolist())
    before = read(predict_file(town, file)["out"])
    assert "refused" not in before[0]
    Promise(evidence, known, np.tile(np.arange(3), 60), 5.0).store(tmp_path / "model.ckpt")
    asked = [f"ckpt={tmp_path}/model.ckpt", f"places={file}", "overwrite=true"]
    done = knock(COMMANDS["predict"].run, "predict", [*asked, f"hydra.run.dir={tmp_path}/run"])
    after = read(file.with_name("asked.predicted.csv"))
    far = column(after, "y") > 100
    assert column(after, "refused").tolist() == far.tolist()
    assert column(after, "rssi_db") == pytest.approx(column(before, "rssi_db"))
    wider = column(after, "rssi_db_std") / column(before, "rssi_db_std")
    assert wider[far] == pytest.approx(1) and wider[~far].mean() == pytest.approx(2, rel=0.2)
    assert any("3 of 9 predictions are refused" in line for line in (*done.out, *done.err)), done
