"""Copies of rows count once, and what draws rows does not ask for their order in the file."""

import numpy as np
import pytest
from layouts import KINDS, POSTS, rows_of

import gsparc
from gsparc.data.row_order import merge_fixes, order_rows
from gsparc.data.splits import Fold
from gsparc.datasets.describe import describe
from gsparc.models import device_offsets
from gsparc.tables.heads import KINDS as TABLE_KINDS
from gsparc.tables.own import from_arrays, interpret
from gsparc.tables.raw import Raw
from gsparc.tables.read import parse_table

NONE = np.zeros(0, np.int64)


def measurements(arrays: dict[str, np.ndarray], order: np.ndarray):
    return from_arrays(
        {name.lstrip("_"): a if name[0] == "_" else a[order] for name, a in arrays.items()}
    )


@pytest.mark.parametrize("kind", KINDS)
def test_any_order_of_the_file_is_one_order(kind):
    """Rows for learning were drawn by their numbers:
    a drive reversed was answered otherwise by 1 dB.
    """
    arrays, every = rows_of(kind), []
    for order in (np.arange(60), np.arange(60)[::-1], np.random.default_rng(1).permutation(60)):
        data = measurements(arrays, order)
        east = data.moving[:, 0] > np.median(data.moving[:, 0])
        every.append(order_rows(data, Fold(np.flatnonzero(east), np.flatnonzero(~east), NONE)))
    (data, fold), *others = every
    assert len(fold.train) and len(fold.val)
    for other, its in others:
        for name in ("tx", "rx_position", "target", "mask", "station", "place", "censored"):
            assert np.array_equal(getattr(data, name), getattr(other, name)), name
        assert np.array_equal(fold.train, its.train) and np.array_equal(fold.val, its.val)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "copied", [lambda n: np.tile(n, 2), lambda n: np.repeat(n, 2), lambda n: np.r_[n, n[:20]]]
)
def test_rows_that_stand_twice_count_once(kind, copied):
    """A packet logged twice told of coherence, noise and lengths;
    lists of the strongest were not seen.
    """
    arrays, rows = rows_of(kind), np.arange(60)
    once, more = measurements(arrays, rows), measurements(arrays, copied(rows))
    assert len(more) == len(once) and np.array_equal(
        np.sort(once.moving, 0), np.sort(more.moving, 0)
    )
    assert dict(describe(once)).get("phases") == dict(describe(more)).get("phases")
    note = f"copies of other rows (same places, station and values): {len(copied(rows)) - 60}"
    raw = Raw(
        {name.lstrip("_"): a if name[0] == "_" else a[copied(rows)] for name, a in arrays.items()},
        {},
    )
    assert any(one.startswith(note[:40]) for one in interpret(raw, "file").notes)


def visits():
    """Links, fixes, levels and devices of ten visits of twenty places."""
    place = np.repeat(np.arange(20), 10)
    return place, place, np.round(np.random.default_rng(0).normal(-70, 1, 200)), place * 0


def test_equal_whole_decibels_of_visits_are_measurements():
    """A place visited ten times hears the same whole decibel again: evidence,
    unless all is doubled.
    """
    rows = visits()
    levels, over = merge_fixes(*rows)
    assert not over.any() and np.array_equal(levels, rows[2])
    twice = np.tile(np.arange(200), 2)
    assert merge_fixes(*(part[twice] for part in rows))[1].sum() == 200


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_rows_of_one_fix_are_one_row_with_or_without_copies(copies):
    """A phone that stood for a minute at one fix counted as a hundred measurements there."""
    rng = np.random.default_rng(2)
    level = rng.normal(-80, 6, 30).round()
    still = np.r_[np.arange(30), [4] * 40]
    levels = np.r_[level, level[4] + rng.choice([-1, 0, 1], 40)]
    rows = np.repeat(np.arange(70), copies)
    merged, over = merge_fixes(still[rows], still[rows], levels[rows], 0 * rows)
    assert (~over).sum() == 30
    assert merged[~over][4] == pytest.approx(level[4])  # of three values
    # A mark is no level of that fix, whose rows stay, each value once
    with_marks = np.where(np.arange(70) == 50, -140.0, levels)
    _, over = merge_fixes(still, still, with_marks, 0 * still)
    assert (~over).sum() == 29 + 4


def test_two_devices_that_read_the_same_level_are_two_measurements():
    """The second phone's row of equal whole decibels was left out as a copy of the first's."""
    arrays = rows_of("powers")
    twice = np.repeat(np.arange(60), 2)
    rows = {name: a if name[0] == "_" else a[twice] for name, a in arrays.items()}
    rows["device"] = np.tile(["first", "second"], 60)
    assert len(measurements(rows, np.arange(120))) == 120
    rows["device"] = np.full(120, "first")
    assert len(measurements(rows, np.arange(120))) == 60


OPTIONS = {
    "device": lambda i, rng: f"phone {i % 3}",
    "run": lambda i, rng: f"day {i // 90}",
    "time_s": lambda i, rng: f"{rng.uniform(0, 1e4):.3f}",
    "sensitivity_db": lambda i, rng: "-110",
    "carrier_hz": lambda i, rng: f"{1e9 + 1e9 * (i % 2):g}",
    "row_name": lambda i, rng: f"r{rng.integers(9)}",
}


def test_every_option_of_columns_that_is_of_rows_is_shuffled_here():
    ends, csi = ("_x", "_y", "_z", "latitude", "longitude"), ("csi", "frequency", "spacing")
    of_rows = {name for name in TABLE_KINDS if not name.endswith(ends) and not name.startswith(csi)}
    assert of_rows - {"x", "y", "z", "rssi", "rssi_db", "station"} == OPTIONS.keys()


@pytest.mark.parametrize("options", [*((name,) for name in OPTIONS), ("device", "run", "time_s")])
@pytest.mark.parametrize("stations", [1, 3])
def test_rows_of_a_table_shuffled_with_any_columns_are_one_order(write, options, stations):
    """Visits of a place were counted in the order of the file: other rows of devices were drawn,
    .1 dB.
    """
    rng, lines = np.random.default_rng(0), []
    for i in range(270):
        place, station = i // 9, i % stations
        more = [OPTIONS[name](i, rng) for name in options]
        lines.append(
            ",".join(
                [f"{place * 7 % 30},{place},1.5,{-60 - rng.integers(40)}", f"s{station}", *more]
            )
        )
    heads = ",".join(["x_m,y_m,z_m,rsrp_dbm,station", *options])
    listed = write(
        "name,x_m,y_m,z_m\n" + "".join(f"s{t},{40 * t},5,9\n" for t in range(3)), "stations.csv"
    )
    every = []
    for order in (np.arange(270), np.arange(270)[::-1], rng.permutation(270)):
        file = write("\n".join([heads, *(lines[i] for i in order)]))
        data = interpret(parse_table(file, {name: name for name in options}, listed), file).data
        every.append(order_rows(data, Fold(NONE, NONE, NONE))[0])
    first, *others = every
    names = np.array(first.site.every_station.name)
    for other in others:
        for name in ("tx", "rx_position", "target", "mask", "place", "censored", "device", "run"):
            assert np.array_equal(getattr(first, name), getattr(other, name)), name
        stations_of_other = np.array(other.site.every_station.name)[other.stations_of()]
        assert np.array_equal(names[first.stations_of()], stations_of_other)


def test_answers_of_devices_at_visits_of_places_did_not_stay_the_same_when_shuffled(monkeypatch):
    """They moved by .1 dB: other rows told the offsets of devices."""
    monkeypatch.setattr(device_offsets, "MOST_ROWS", 100)
    rng = np.random.default_rng(1)
    place = np.c_[rng.uniform(0, 100, (60, 2)), np.full(60, 1.5)].repeat(9, axis=0)
    station, device = np.tile([0, 1, 2], 180), np.tile(np.repeat([0, 1, 2], 3), 60)
    level = -40 - 30 * np.log10(np.linalg.norm(place - POSTS[station], axis=1)) + 4 * device
    level = (level + rng.normal(0, 1, 540)).round(1)
    kept = np.flatnonzero(rng.random(540) > 0.15)
    rows = {"rx": place, "rssi": level, "station": station, "device": np.array(list("abc"))[device]}
    answers = []
    for order in (kept, rng.permutation(kept)):
        model = gsparc.fit(
            **{k: v[order] for k, v in rows.items()}, station_position=POSTS, model="gp"
        )
        answers.append(model.rssi(rx=place[::9]))
    assert np.abs(answers[0] - answers[1]).max() < 1e-3
