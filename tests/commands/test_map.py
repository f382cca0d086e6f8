"""`gsparc map` and `gsparc plan`: files whole, a promise kept with the model,
errors in one line.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from doors import assert_refused, knock
from PIL import Image
from towns import town_file, town_model, trained

from gsparc.apps.maps.placing import place_station
from gsparc.commands.listing import COMMANDS


def run(command, *settings, folder):
    return knock(
        COMMANDS[command].run, command, [*settings, f"hydra.run.dir={folder}", "threads=1"]
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return Path(shutil.copy(town_model(), tmp_path_factory.mktemp("model") / "model.ckpt"))


@pytest.fixture(scope="module")
def mapped(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    Image.new("RGB", (400, 300), "white").save(folder / "floor.png")
    plan = [f"plan={folder / 'floor.png'}", "plan_points=[[0,300,0,0],[400,300,80,0]]"]
    done = run("map", f"ckpt={model}", "step_m=2", "threshold_db=-85", *plan, folder=folder)
    assert done.status == 0, done
    return folder, "\n".join(done.out)


@pytest.mark.slow
def test_every_layer_and_a_table(mapped):
    folder, said = mapped
    layers = (
        "power",
        "best_server",
        "sinr",
        "outage",
        "expected_error",
        "width",
        "stations/power_west",
        "stations/power_east",
    )
    assert all((folder / f"{name}.png").stat().st_size > 5000 for name in layers)
    facts = json.loads((folder / "summary.json").read_text())
    assert facts["promise/calibrated"] == 1 and 0.8 < facts["promise/held/share"] <= 1
    assert facts["map/stations"] == 2 and "held-out blocks" in said
    assert f"expected error {facts['map/expected_error_db']:.2f} dB" in said
    ends = facts["map/covered_low"], facts["map/covered_high"]  # a covered share had no interval
    assert 0 <= ends[0] < 1 - facts["map/outage"] < ends[1] <= 1 and "; 90 % interval" in said
    with np.load(folder / "map.npz") as found:
        told = np.isfinite(found["power_db"])
        assert found["power_db"].shape == (2, 30, 40) and told.mean() > 0.8
        assert (found["lower_db"] < found["upper_db"])[told].all()
        assert np.isnan(found["lower_db"][~told]).all()


def test_a_plan_from_the_model(mapped, model, tmp_path):
    """Places were in the order of gains without a way between them,
    unless somebody said `route=true`.
    """
    done = run("plan", f"ckpt={model}", "count=6", "area=[-20,0,80,60]", folder=tmp_path)
    assert done.status == 0, done
    (said,) = [line for line in done.out if "6 places: expected error" in line]
    assert "of the strongest station" in said
    facts = json.loads((tmp_path / "summary.json").read_text())
    assert 0 < facts["plan/expected_error_db"] < facts["plan/expected_error_before_db"]
    lines = (tmp_path / "plan.csv").read_text().splitlines()
    assert len(lines) == 7 and lines[0].endswith(",way_m") and (tmp_path / "plan.png").exists()
    assert any(
        "a way of" in one and "; rows logged on the way do not count" in one for one in done.out
    )
    how = [f"ckpt={model}", "count=1", "promised=false"]
    done = run("plan", *how, "threshold_db=-80", folder=tmp_path)
    assert any("of the strongest station, where -80 is in doubt" in one for one in done.out), done
    done = run("plan", *how, "goal=all", folder=tmp_path)
    assert any("of all stations alike (a map shows the strongest)" in one for one in done.out), done


def test_a_plan_did_not_say_how_many_stations_a_place_lists(mapped, model, tmp_path, monkeypatch):
    monkeypatch.setattr("gsparc.apps.maps.promise.Promise.stations_of_place", lambda self: 1)
    done = run("plan", f"ckpt={model}", "count=1", "area=[-20,0,80,60]", folder=tmp_path)
    assert any(
        ", if a place lists the 1 strongest of 2; plan written" in line for line in done.out
    ), done


def test_the_file_of_a_way_held_no_stops(model, tmp_path):
    assert run("plan", f"ckpt={model}", "count=6", "promised=false", folder=tmp_path).status == 0
    way, *stops = json.loads((tmp_path / "plan.geojson").read_text())["features"]
    length_m = np.hypot(*np.diff(way["geometry"]["coordinates"], axis=0).T).sum()
    assert way["geometry"]["type"] == "LineString"
    assert length_m == pytest.approx(
        json.loads((tmp_path / "summary.json").read_text())["plan/length_m"], abs=0.01
    )
    assert [one["properties"] for one in stops] == pd.read_csv(tmp_path / "plan.csv").to_dict(
        "records"
    )
    assert all(one["geometry"]["type"] == "Point" for one in stops)
    first = stops[0]["properties"]
    assert stops[0]["geometry"]["coordinates"] == [first["x"], first["y"]]
    assert {"rank", "order"} <= first.keys()


def test_a_plan_for_some_stations_spoke_of_all(model, tmp_path):
    how = ("count=2", "stations=[west]", "promised=false", "route=false")
    done = run("plan", f"ckpt={model}", *how, folder=tmp_path)
    (said,) = [line for line in done.out if "2 places: expected error" in line]
    assert " of west; plan written " in said and not (tmp_path / "plan.geojson").exists()


def test_a_model_that_cannot_place_was_restored_before_it_said_so(model, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "gsparc.commands.place.open_run", lambda *_: pytest.fail("all stations are restored")
    )
    answer = run("place", f"ckpt={model}", folder=tmp_path)
    assert_refused(answer, "train with stations=together", tmp_path)


@pytest.mark.slow
def test_an_interval_of_no_width_was_written_where_none_is_known(tmp_path):
    """Two stations, of which none can be left out; gains stood in no file."""
    path = trained(
        town_file(tmp_path / "town.npz"), "distance_law", "stations=together", "split=none"
    )
    how = ("count=4", "threshold_db=-75", "promised=false")
    done = run("place", f"ckpt={path}", *how, folder=tmp_path / "to")
    assert done.status == 0 and any("no interval is known" in line for line in done.out), done
    (said,) = [line for line in done.out if "gaining" in line]
    assert " m from the next: " in said and "interval" not in said
    table = pd.read_csv(tmp_path / "to" / "place.csv")
    assert table[["low", "high", "gain_low", "gain_high"]].isna().all(axis=None)
    facts = json.loads((tmp_path / "to" / "summary.json").read_text())
    assert facts["place/low"] is None and facts["place/gain"] == pytest.approx(table["gain"].max())


def test_a_best_place_was_not_said_to_be_like_others(tmp_path, monkeypatch):
    path = trained(
        town_file(tmp_path / "town.npz"), "distance_law", "stations=together", "split=none"
    )
    gain, ends = (
        np.array([0.1, 0.09, 0.05, 0.01]),
        [[0.04, 0.2], [0.03, 0.2], [0.02, 0.1], [0.0, 0.02]],
    )

    def with_intervals(*of, **how):
        found = place_station(*of, **how)
        return replace(found, gain=gain, between=np.column_stack([np.full((4, 2), 0.5), ends]))

    monkeypatch.setattr("gsparc.apps.maps.placing.place_station", with_intervals)
    done = run(
        "place", f"ckpt={path}", "count=4", "promised=false", "left_out=0", folder=tmp_path / "to"
    )
    assert any(line.endswith(", gaining 10.0 points") for line in done.out), done
    told = "of the gain 4.0 to 20.0 points, not significantly above 2 of 3 others"
    assert any(told in line for line in done.out)


@pytest.mark.slow
def test_a_single_candidate_was_not_told_apart_from_no_others(tmp_path, monkeypatch):
    path = trained(
        town_file(tmp_path / "town.npz"), "distance_law", "stations=together", "split=none"
    )

    def with_an_interval(*of, **how):
        return replace(place_station(*of, **how), between=np.array([[0.4, 0.6, 0.0, 0.2]]))

    monkeypatch.setattr("gsparc.apps.maps.placing.place_station", with_an_interval)
    done = run(
        "place", f"ckpt={path}", "count=1", "promised=false", "left_out=0", folder=tmp_path / "to"
    )
    assert any(line.endswith("of the gain 0.0 to 20.0 points") for line in done.out), done


@pytest.mark.slow
def test_a_station_among_others_of_no_known_place_was_no_number_of_metres_away(tmp_path):
    """`place` ended in `TypeError: unsupported format string`."""
    values = dict(np.load(town_file(tmp_path / "town.npz")))
    values["station_position"] = np.full_like(values["station_position"], np.nan)
    np.savez(tmp_path / "town.npz", **values)
    path = trained(tmp_path / "town.npz", "gsparc", "stations=together", "split=none")
    how = ("count=4", "threshold_db=-75", "promised=false", "station_height_m=8")
    done = run("place", f"ckpt={path}", *how, folder=tmp_path / "to")
    assert done.status == 0 and not any("from the next" in line for line in done.out), done


def test_a_map_and_its_model_are_judged_by_later_rows_alike(model, tmp_path):
    """By cell, ring and area, with a picture; rows are asked for where none are given."""
    rows, quick = town_file(tmp_path / "later.npz", rows=400, seed=1), f"ckpt={model}"
    how = "step_m=1", "pictures=false", "promised=false", "geotiff=false"
    assert run("map", quick, *how, folder=tmp_path / "map").status == 0
    file, parts = tmp_path / "map" / "map.npz", {}
    for name, judged in (("map", file), ("model", model)):
        out = tmp_path / f"by_{name}"
        done = run("evaluate", f"ckpt={judged}", f"dataset.file={rows}", "baselines=[]", folder=out)
        assert done.status == 0 and (out / "drive.png").exists(), done
        assert "predicted less measured" in " ".join(done.out)
        table = pd.read_csv(out / "by_part.csv")
        assert {"all", "cell", "ring", "area"} == {*table.part}
        parts[name] = table[table.part == "cell"].set_index("name").rmse_db
    assert {*parts["map"].index} == {"east", "west"}
    assert np.allclose(parts["map"], parts["model"][parts["map"].index], atol=0.4)
    assert_refused(run("evaluate", f"ckpt={file}", folder=tmp_path / "no"), "dataset.file=FILE")


def test_a_map_of_an_end_that_stands_anywhere(model, tmp_path):
    """Of twenty places and more; one model a station says what it lacks."""
    rng = np.random.default_rng(0)
    ends = np.c_[rng.uniform(0, 20, (24, 2)), np.ones(24)]
    station = np.repeat(np.arange(24), 20)
    places = np.c_[rng.uniform(0, 20, (480, 2)), np.ones(480)]
    away = np.linalg.norm(places - ends[station], axis=1)
    level = -40 - 20 * np.log10(away + 0.1) + 4 * np.sin(ends[station, 0]) + rng.normal(0, 1, 480)
    arrays = {"station_position": ends, "station": station, "rssi_db": level}
    file = tmp_path / "links.npz"
    np.savez(file, rx_position=places, **arrays)
    links = trained(file, "gsparc", "split=none")
    how = "step_m=2", "geotiff=false", "threshold_db=-60"
    done = run("map", f"ckpt={links}", "other_end=[10,10,1]", *how, folder=tmp_path / "map")
    assert done.status == 0 and (tmp_path / "map" / "outage.png").exists(), done
    facts = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert facts["map/stations"] == 1 and facts["promise/calibrated"] == 0
    refused = run("map", f"ckpt={model}", "other_end=[10,10,1]", *how, folder=tmp_path / "no")
    assert_refused(refused, "no station stands")
