"""Data of another file in the coordinates, units and stations of a model."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

import gsparc
from gsparc.base.errors import DataError
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold, Split, make_split
from gsparc.datasets.load import drop_unanswerable_rows
from gsparc.evaluation.scores import score_methods
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.runs import open_runs
from gsparc.runs.align_site import align_to_site
from gsparc.runs.baselines import fit_baseline
from gsparc.runs.open_runs import Opened, open_run
from gsparc.tables.own import from_arrays
from gsparc.tables.read import parse_table
from gsparc.training.context import FitContext

RNG = np.random.default_rng(0)
WALK = np.column_stack([RNG.uniform(0, 50, (80, 2)), np.full(80, 1.5)])
POSTS = np.array([[0.0, 0, 5], [50, 0, 5], [25, 60, 5]])
LEVELS = -20 * np.log10(np.linalg.norm(WALK[:, None] - POSTS, axis=-1)) - np.array([0.0, 30, 60])
NAMES = np.array(["north", "east", "roof"])


def town(chosen=(0, 1, 2), **changes):
    """The stations `chosen`, in that order."""
    some = list(chosen)
    arrays = {"rx_position": WALK, "station_position": POSTS[some], "rssi_db": LEVELS[:, some]}
    return from_arrays({**arrays, "station_name": NAMES[some], **changes})


@pytest.mark.parametrize("chosen", [(2, 0, 1), (1, 2), (2,)])
def test_stations_in_another_order_were_answered_by_each_other(chosen):
    """One file lists the stations of a model in another order, or some of them:
    31 dB off without a word.
    """
    data, other = town(), town(chosen)
    method = wrap_per_station(method_class("idw")(), data)
    method.fit(
        data, make_split(data.moving, SplitSettings(), place=data.place).folds[0], FitContext()
    )
    same = align_to_site(other, data.site)
    assert [NAMES[t] for t in same.station[: len(chosen)]] == [NAMES[t] for t in chosen]
    split = make_split(same.moving, SplitSettings(), place=same.place)
    assert score_methods([method], same, split).figures()["rmse_db"] < 4


@pytest.mark.parametrize(("model", "unit", "power"), [("dBm", "W", -3), ("dBW", "mW", 0)])
def test_watts_were_asked_of_a_model_of_milliwatts(tmp_path, model, unit, power):
    """Errors of 30 dB beside baselines of one: a table of levels in dBm, another of powers in W."""
    heads = f"x,y,z,power [{unit}]\n"
    rows = (
        f"{x},{y},{z},{10 ** (level / 10 + power)}\n"
        for (x, y, z), level in zip(WALK, LEVELS[:, 0], strict=True)
    )
    (tmp_path / "drive.csv").write_text(heads + "".join(rows))
    given = {
        "rx_position": WALK,
        "tx_position": POSTS[0],
        "rssi_db": LEVELS[:, 0] - 30 * (model == "dBW"),
    }
    data = from_arrays(given, {"level_unit": model})
    table = parse_table(tmp_path / "drive.csv")
    other = from_arrays({**table.arrays, "tx_position": POSTS[0]}, table.attributes)
    same = align_to_site(other, data.site)
    np.testing.assert_allclose(same.target, data.target, rtol=1e-5)
    assert (same.site.level_unit, same.site.target_scale) == (model, data.site.target_scale)


def test_a_second_survey_was_refused_where_it_heard_new_stations(caplog):
    """New access points are the rule: what is known is judged, the others' rows are counted."""
    site = town((0, 1)).site
    said = "stations roof of arrays are none of the model's, north, east, by name and place"
    known = align_to_site(town(), site)
    assert {*known.station.tolist()} == {0, 1} and known.site.stations.name == site.stations.name
    np.testing.assert_allclose(known.target, align_to_site(town((0, 1)), site).target, rtol=1e-5)
    assert f"{said}: {len(WALK)} of {3 * len(WALK)} rows are left out" in caplog.text
    with pytest.raises(
        ValueError, match=said + r"; dataset\.stations"
    ):  # a training would learn from less than it was given
        align_to_site(town(), site, whole=True)
    refused(r"stations roof .* no name in common", align_to_site, town((2,)), site)
    alone = from_arrays({"rx_position": WALK, "tx_position": POSTS[0], "rssi_db": LEVELS[:, 0]})
    with pytest.raises(ValueError, match="arrays has one static end, the model 3 stations"):
        align_to_site(alone, replace(town().site, name="arrays"))


def test_a_drive_that_names_cells_otherwise_was_to_leave_them_out():
    """A second drive by PCI was refused, though the list of cells holds both names of each."""
    mast, pci = {"station_position": POSTS[[0, 0, 0]]}, np.array(["211", "212", "213"])
    site = town(**mast).site
    second = {"station_name": pci[[2, 0, 1]], "station_label": NAMES[[2, 0, 1]]}
    same = align_to_site(town((2, 0, 1), **mast, **second), site)
    assert same.site.stations.name == site.stations.name and same.station[:3].tolist() == [2, 0, 1]
    # The model's drive was the one by PCI
    listed = town(**mast, station_name=pci, station_label=NAMES).site
    assert align_to_site(town((1, 0, 2), **mast), listed).station[:3].tolist() == [1, 0, 2]
    said = (
        "stations 211, 212, 213 of arrays are none of the model's, north, east, roof: no name "
        "in common"
    )
    with pytest.raises(
        ValueError, match=said + ".*dataset.columns.station=COLUMN.*stations_file=FILE"
    ):
        align_to_site(town(**mast, station_name=pci), site)


@pytest.mark.parametrize("lost", ["file", "model"])
def test_stations_of_equal_names_were_unknown_where_one_had_no_places(lost):
    """A list of cells beside the second drive alone, or beside the first,
    made all its cells strangers.
    """
    nowhere = {"station_position": np.full((3, 3), np.nan)}
    file, model = (town((2, 0, 1), **(nowhere if lost == one else {})) for one in ("file", "model"))
    same = align_to_site(file, model.site)
    assert same.station[:3].tolist() == [0, 1, 2]
    places = model.site.stations.position[same.station]
    np.testing.assert_allclose(same.tx, places, equal_nan=True)


def test_degrees_about_another_origin_were_taken_for_the_same_metres():
    """Another part of a drive has another origin: its places were hundreds of metres off."""
    latitude, longitude = 48 + np.linspace(0, 0.06, 80), 179.99 + RNG.uniform(0, 0.02, 80)
    levels_db = np.linspace(-90, -50, 80)

    def drive(rows):
        degrees = {"latitude": latitude[rows], "longitude": longitude[rows], "rx_height": 1.5}
        return from_arrays({**degrees, "rssi_db": levels_db[rows]})

    whole, part = drive(slice(None)), drive(slice(50, None))
    assert whole.site.georeference != part.site.georeference
    same = align_to_site(part, whole.site)
    np.testing.assert_allclose(same.rx_position, whole.rx_position[50:], atol=1e-3)
    assert same.site.georeference == whole.site.georeference


def test_places_in_degrees_were_said_to_be_apart_from_a_model_s_of_an_unknown_origin(tmp_path):
    """`0 of these 80 test rows are at places that were TRAINED on`, of the very same places."""
    place, level = WALK, np.linspace(-90, -50, 80)
    gsparc.fit(rx=place, rssi=level, model="mean", save=tmp_path / "model.ckpt")
    degrees = {"latitude": 48 + place[:, 1] / 111_000, "longitude": 2 + place[:, 0] / 74_000}
    np.savez(tmp_path / "drive.npz", **degrees, rx_height=np.array(1.5), rssi_db=level)
    own = {"name": "own", "file": str(tmp_path / "drive.npz")}
    run = open_run(tmp_path / "model.ckpt", own).read({"name": "random"})
    assert run.learned is None and "about an unknown origin" in run.foreign


def opened_beside_all(folder, monkeypatch, **changes):
    """A drive of 80 places, all asked of a model that learned from all of another one."""
    drive = {"rx_position": WALK, "rssi_db": np.linspace(-90, -50, 80)}
    gsparc.fit(rx=WALK, rssi=drive["rssi_db"], model="mean", save=folder / "model.ckpt")
    np.savez(folder / "drive.npz", **(drive | changes))
    learned, rows = from_arrays(drive), np.arange(80)
    split = Split("all", (Fold(rows, rows[:0], rows[:0]),))
    monkeypatch.setattr(
        open_runs, "_trained", lambda stored, data: (align_to_site(learned, data.site), split)
    )
    own = {"name": "own", "file": str(folder / "drive.npz")}
    return open_run(folder / "model.ckpt", own).read(others_whole=True)


def test_test_rows_of_a_drive_counted_unlisted_cells_as_lines(tmp_path, monkeypatch):
    """`5400 test rows` of a file of 1,800 lines."""
    level = np.linspace(-90, -50, 80)
    level[:30] = -np.inf
    said = opened_beside_all(
        tmp_path, monkeypatch, rssi_db=level, sensitivity_db=np.array(-95.0)
    ).foreign
    assert "80 of these 80 test rows (50 listed, 30 unlisted) are at places" in said


def test_rows_that_none_was_trained_on_read_as_an_alarm(tmp_path, monkeypatch):
    """`0 of these 80 test rows are at places that were TRAINED on`, of `split whole`."""
    run = opened_beside_all(tmp_path, monkeypatch, rx_position=WALK + 500.0)
    assert run.foreign.endswith("none of these 80 test rows are at places that were trained on")
    assert run.split.title == "whole (all rows of the file are asked)"


def test_baselines_of_a_file_are_not_those_of_its_renumbered_stations():
    """A cache told data apart by their content,
    not by the numbers that a model has for their stations.
    """
    other = town((2, 0, 1))
    split = make_split(other.moving, SplitSettings(), place=other.place)
    for data in (other, align_to_site(other, town().site)):
        assert fit_baseline("idw", data, split).scores.figures()["rmse_db"] < 4
    found = fit_baseline("idw", align_to_site(other, town().site), split, "train")
    assert found.scores.figures()["rmse_db"] < 1e-3


@pytest.fixture
def room():
    """Complex channels of one transmitter in a small room, a kilometre from the origin."""
    rx = np.random.default_rng(0).uniform([1000, 0, 0], [1004, 4, 4], (40, 3))
    distance = np.linalg.norm(rx - [1002, 2, 1], axis=1)
    csi = np.exp(-1j * distance) / distance
    ends = {"tx_position": np.array([1002.0, 2, 1]), "rx_position": rx}
    return from_arrays({**ends, "csi": csi, "frequency_hz": 2.4e9})


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("static_position", lambda place: place + np.eye(3)[0], "is 1 m from"),
        ("kind", lambda kind: "rssi", "with kind csi"),
    ],
)
def test_data_of_another_place_or_kind_are_refused(room, name, change, message):
    other = replace(room, site=replace(room.site, **{name: change(getattr(room.site, name))}))
    refused(message, align_to_site, other, room.site)


def test_what_is_in_target_units_is_converted_with_the_target(room):
    """An uplink kept its own unit: whoever hears it
    and predicts a downlink was wrong by the ratio.
    """
    heard = np.full((len(room), 2, 3), 1 + 1j, np.complex64)
    noise = np.full(len(room), 0.5, np.float32)
    louder = replace(room.site, target_scale=room.site.target_scale * 4)
    back = align_to_site(
        replace(
            room, site=louder, target=room.target / 4, uplink=heard / 4, noise_variance=noise / 16
        ),
        room.site,
    )
    assert np.allclose(back.target, room.target)
    assert np.allclose(back.uplink, heard) and np.allclose(back.noise_variance, noise)
    assert back.uplink.dtype == np.complex64 and back.noise_variance.dtype == np.float32


def test_locate_built_whatever_class_a_checkpoint_named():
    """Settings that the stored class does not follow were instantiated, `os.system` as well."""
    settings = {"model": {"_target_": "os.system", "command": "true"}, "seed": 3, "effort": 2.0}
    split = SimpleNamespace(folds=[None])
    run = Opened([None], [SimpleNamespace(configuration=settings, path="a.ckpt")], {}, None, split)
    refused(r"os\.system.*refused", run.retraining, 5.0)
    settings["model"] = {"_target_": "gsparc.models.baselines.nearest.Nearest"}
    context = run.retraining(5.0).context
    assert (context.seed, context.effort, context.stations) == (3, 5.0, "auto")
    run.stored[0].configuration = {}
    with pytest.raises(DataError, match=r"a\.ckpt does not say how it was trained"):
        run.retraining()


@pytest.mark.parametrize("placed", [True, False])
def test_a_second_survey_had_no_table_where_a_station_was_rarely_heard_before(placed, caplog):
    """`zero: station roof had too few training rows`, after minutes."""
    before, none, every = LEVELS.copy(), np.arange(0), np.arange(240)
    before[2:, 2] = np.nan
    posts = POSTS if placed else np.full_like(POSTS, np.nan)
    first, second = town(rssi_db=before, station_position=posts), town(station_position=posts)
    learned = Split("none", (Fold(np.arange(len(first)), none, none),))
    chosen = drop_unanswerable_rows(
        Split("whole", (Fold(none, none, every),)), second, (first, learned)
    )
    assert set(second.station[chosen.folds[0].test]) == {0, 1}
    assert (
        "test rows are left out, of stations with under 4 training rows; heard now: roof (in 8"
        in caplog.text
    )
    for name in ("zero", "kriging"):
        fit_baseline(name, second, chosen, learned=(first, learned))
