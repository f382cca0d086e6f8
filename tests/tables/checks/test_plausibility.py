"""Warnings about readable measurements: each is given where it should be, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from level_fields import flight
from releases import real
from scipy.spatial.distance import cdist

from gsparc.datasets.own import read_any
from gsparc.tables.checks import plausibility
from gsparc.tables.checks.level_steps import (
    LinkLevels,
    detect_level_steps,
    find_level_steps,
    link_levels,
    step_warnings,
)
from gsparc.tables.checks.plausibility import unit_warnings
from gsparc.tables.own import from_arrays


def walk(seed, count=600, step=8.0):
    """Places (n, 2) [m] of a walk, its levels (n,) [dB] with correlated shadowing,
    and the station (2,).
    """
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.25, count))
    place = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1) * step, axis=0)
    covariance = 25 * np.exp(-cdist(place, place) / 50) + 1e-9 * np.eye(count)
    shadow = np.linalg.cholesky(covariance) @ rng.normal(size=count)
    station = place.mean(0) + rng.normal(0, 200, 2)
    distance = np.linalg.norm(place - station, axis=1)
    return place, -30 - 35 * np.log10(distance + 5) + shadow + rng.normal(0, 2, count), station


def as_links(position, level_db, names, station_position=None) -> LinkLevels:
    """Links of a wide table: places (S, d), levels (S, T), stations (T, d)."""
    rows, count = level_db.shape
    return LinkLevels(
        np.repeat(position, count, axis=0),
        np.tile(np.arange(count), rows),
        level_db.reshape(-1),
        [f"row {i // count}" for i in range(rows * count)],
        np.repeat(np.arange(rows), count),
        names,
        names,
        station_position,
    )


def warnings_of(levels: LinkLevels | None):
    assert levels is not None
    return plausibility.sanity_warnings(levels, find_level_steps(levels))


def room(seed=0, count=100):
    rng = np.random.default_rng(seed)
    place = rng.uniform([0, 0, 0.5], [6, 5, 2], (count, 3))
    return place, -40 - 20 * np.log10(np.linalg.norm(place - [3, 2, 2.5], axis=1)) + rng.normal(
        0, 1, count
    )


def test_a_sound_room_raises_none():
    place, level = room()
    assert warnings_of(as_links(place, level[:, None], ["a"], np.array([[3, 2, 2.5]]))) == []


def measured_at(place):
    return from_arrays(
        {"rx_position": place, "tx_position": np.median(place, axis=0), "rssi_db": room()[1]}
    )


@pytest.mark.parametrize(
    "position, said",
    [
        (lambda p: np.round(p * [600, 600, 1]), "in millimetres, centimetres or feet?"),
        (lambda p: p * [1, 1, 1000], "in millimetres, centimetres or feet?"),
        (lambda p: p / 1000, "in kilometres?"),
        (
            lambda p: p * [300, 300, 1] + 30e3 * np.outer(np.arange(len(p)) % 2, [1, 0, 0]),
            "places fill a box of",
        ),
        (lambda p: np.array([40.76, -111.8, 0]) + p / 1e3, "degrees? then give"),
        (lambda p: p, None),
        (lambda p: p + np.array([4e5, 5e6, 100]), None),  # UTM
        (lambda p: p / 5 + [3, 1, 0], None),  # a small table far from the origin
        (np.round, None),
    ],
)
def test_units_of_positions(position, said):
    found = unit_warnings(measured_at(position(room()[0])))
    assert len(found) == (said is not None) and all(said in line for line in found), found


@pytest.mark.parametrize(
    "latitude, longitude, said",
    [
        ([-74.0, -74.1], [40.7, 40.8], "Antarctic"),
        ([80.2, 80.3], [13.0, 13.1], "Arctic"),
        # Was 57 times too small
        (np.radians([48.1, 48.2]), np.radians([11.5, 11.6]), "at sea: radians?"),
    ],
)
def test_degrees(latitude, longitude, said):
    found = plausibility.degree_warnings(np.array(latitude), np.array(longitude))
    assert len(found) == 1 and said in found[0], found


@pytest.mark.parametrize(
    "level, said",
    [
        (lambda v: 10 ** (v / 10), "or linear (give it as rssi"),
        (lambda v: -v + 40, "losses (store minus them; dataset.columns.rssi_db=HEAD*-1), per cent"),
        (lambda v: np.round((v + 100) / 2), "an index, or linear"),
    ],
)
def test_levels(level, said):
    found = plausibility.level_warnings(level(room()[1]))
    assert len(found) == 1 and said in found[0], found


def test_whole_decibels_are_sound():
    assert plausibility.level_warnings(np.round(room()[1])) == []
    assert plausibility.level_warnings(np.array([np.nan, np.nan])) == []


def test_a_fix_that_stands_still_while_levels_change_is_named():
    place, level, _ = walk(0)
    there = place.copy()
    there[60:180] = place[60]
    (found,) = plausibility.still_warnings(as_links(there, level[:, None], ["a"]))
    assert "row 60 to row 179: one place for 120 rows, while levels change by" in found
    # Who waits there hears fading, no way
    waits = np.random.default_rng(0).normal(-70, 6, len(place))
    assert not plausibility.still_warnings(as_links(there, waits[:, None], ["a"]))
    assert not plausibility.still_warnings(as_links(place, level[:, None], ["a"]))


def test_a_wild_row_is_named():
    place, level, _ = walk(0)
    assert plausibility.outlier_row_warnings(as_links(place, level[:, None], ["a"])) == []
    level[123] += 60
    found = plausibility.outlier_row_warnings(as_links(place, level[:, None], ["a"]))
    assert len(found) == 1 and found[0].startswith("row 123: up to") and "row 124" not in found[0]


def test_no_wolf_on_thirty_sound_walks():
    alarms = sum(bool(detect_level_steps(*walk(seed, 400))) for seed in range(30))
    assert alarms == 0


def test_steps_of_little_input():
    place, level, station = walk(0)
    assert detect_level_steps(place[:50], level[:50], station) == []
    assert (
        detect_level_steps(np.zeros((600, 2)), level) == []
        and detect_level_steps(place, level * 0) == []
    )
    assert detect_level_steps(place, np.full(600, np.nan)) == []


def campus(stations=slice(None)) -> LinkLevels:
    """Links of some of twelve stations."""
    with np.load(real("real/powder-rss-462mhz.npz")) as stored:
        level, names = (
            stored["rssi_db"][:, stations].astype(float),
            stored["station"][stations].tolist(),
        )
        return as_links(
            stored["mobile_position"], level, names, stored["station_position"][stations]
        )


def test_a_real_station_that_lost_its_gain():
    """One of four changes: 17 dB more from row 350 on, 19 dB less from row 1462 on,
    after it was off.
    """
    some = campus(slice(5, 9))
    found = step_warnings(some, find_level_steps(some))
    # Two lines proposed [353] and [1462], of which the later setting replaces the first.
    assert len(found) == 1 and "dataset.level_steps={ebc-nuc1-b210:[353,1462]}" in found[0]
    assert "rises by 17 dB between row 345 and row 353 and falls" in found[0]
    assert "falls by 19 dB between row 1155 and row 1462" in found[0]


def test_the_setting_of_a_level_step_named_no_row_of_a_table(tmp_path):
    """Warnings name lines, the setting counts rows: `{STATION:[ROW]}` was left to be filled in."""
    place, level, station = walk(4, 200)
    place, other = place + 1e-3 * np.arange(200)[:, None], walk(3, 400)[1]
    place, level = np.concatenate([place, place + 0.5]), np.concatenate([level, level + 20])
    text = "# a remark\nx,y,A,B\n" + "".join(
        f"{x:.2f},{y:.2f},{a:.2f},{b:.2f}\n"
        for (x, y), a, b in zip(place, level, other, strict=True)
    )
    posts = f"name,x,y\nA,{station[0]:.1f},{station[1]:.1f}\nB,0,0\n"
    (tmp_path / "walk.csv").write_text(text)
    (tmp_path / "posts.csv").write_text(posts)
    reading = read_any(tmp_path / "walk.csv", stations_file=tmp_path / "posts.csv")
    levels = link_levels(reading.data, reading.file_row)
    steps = find_level_steps(levels)
    said = step_warnings(levels, steps)[0]
    first = levels.file_row[steps[0][1].first]
    assert f"and line {first + 3}," in said and f"'dataset.level_steps={{A:[{first}]}}'" in said
    parted = read_any(
        tmp_path / "walk.csv", stations_file=tmp_path / "posts.csv", level_steps={"A": [int(first)]}
    )
    assert f"A from row {first}" in parted.data.site.stations.name


def test_warnings_and_rows_had_other_names_of_a_cell_than_the_rest():
    """`station 150: row 7` of `W03-2 (150)`;
    the setting that a warning gives takes the short one.
    """
    place, level, station = walk(4, 200)
    place, level = np.concatenate([place, place + 0.5]), np.concatenate([level, level + 20])
    links = {
        "rx_position": np.c_[place, np.ones(400)],
        "station_position": np.array([[*station, 9], [0, 0, 9]]),
    }
    labels = {
        "station_name": np.array(["150", "212"]),
        "station_label": np.array(["W03-2", "W03-3"]),
    }
    data = from_arrays({**links, **labels, "rssi_db": np.c_[level, level[::-1].copy()]})
    warnings = warnings_of(link_levels(data))
    assert any(
        w.startswith("station W03-2 (150) rises") and "level_steps={150:[" in w for w in warnings
    )
    assert data.row_names[:2] == ["row 0, station W03-2 (150)", "row 0, station W03-3 (212)"]


def test_rows_of_which_some_have_other_degrees_were_good():
    """Half of the latitudes divided by ten: a box of 4,800 km, whose degrees nobody asked."""
    rng = np.random.default_rng(0)
    latitude, longitude = 48 + rng.uniform(0, 0.02, 80), 11 + rng.uniform(0, 0.02, 80)
    arrays = {"longitude": longitude, "rssi_db": rng.normal(-80, 5, 80), "rx_height": np.array(1.5)}
    assert not unit_warnings(from_arrays({**arrays, "latitude": latitude}))
    half = np.where(np.arange(80) % 2, latitude, latitude / 10)
    (said,) = unit_warnings(from_arrays({**arrays, "latitude": half}))
    assert said.startswith("two groups of places ") and "km apart" in said


@pytest.mark.parametrize("factor, says", [(1e-2, "differ by"), (3.28, "thermal noise of a hertz")])
def test_all_levels_in_another_unit_were_good(factor, says):
    """-80 dBm as -.8, or as -262."""
    level = room()[1]
    found = plausibility.level_warnings((level - 40) * factor)
    assert any(says in line for line in found), found


@pytest.mark.parametrize("share", [0.5, 0.1])
def test_rows_in_dbw_beside_others_in_dbm_were_good(share):
    """Levels spread over 60 dB: no gap between two units, but none between near rows is as wide."""
    rng, arrays = np.random.default_rng(0), flight(0)
    levels = link_levels(from_arrays(arrays))
    assert not plausibility.two_unit_warnings(levels)
    half = rng.random(len(levels.level_db)) < share
    (said,) = plausibility.two_unit_warnings(replace(levels, level_db=levels.level_db - 30 * half))
    assert said.endswith("in two units?")


def test_rows_of_which_half_follow_a_way_are_in_no_order():
    """A median step of 134 m where any two places lie 600 m apart was taken for an order: steps of
    -16 and +14 dB were claimed of a file of two phones, one of which stands anyhow.
    """
    place, level, _ = walk(4, 400)
    rows = np.r_[:200, 200 + np.random.default_rng(0).permutation(200)]
    level[200:] += 20
    links = as_links(place[rows], level[rows, None], ["a"])
    assert as_links(place, level[:, None], ["a"]).ordered and not links.ordered
    assert find_level_steps(links) == []
