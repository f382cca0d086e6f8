import json
from pathlib import Path

import numpy as np
import pytest
from releases import real

from gsparc.base.errors import DataError
from gsparc.data.inner_folds import inner_folds
from gsparc.data.split_files import read_split, write_split
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import hash_indices, make_split
from gsparc.datasets.load import load, split_for
from gsparc.datasets.rfid import load_rfid
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext


def _walk(rows=400, seed=0):
    """A curve with steps of about 1 cm that stays in a metre."""
    steps = np.random.default_rng(seed).normal(size=(rows, 3)) * 0.006
    return np.cumsum(steps, axis=0)


def _disjoint(fold, rows):
    every = np.concatenate([fold.train, fold.val, fold.test])
    return len(np.unique(every)) == len(every) and every.min() >= 0 and every.max() < rows


def test_few_rows_may_be_counted(refused):
    """A protocol of 200 pixels could be drawn as a share of the rows alone."""
    (fold,) = make_split(_walk(), SplitSettings("sparse", train_fraction=20)).folds
    assert len(fold.train) + len(fold.val) == 20 and len(fold.test) == 380
    asked = SplitSettings("sparse", train_fraction=400)
    refused("split.train_fraction=400: there are 400 rows", make_split, _walk(), asked)


@pytest.mark.parametrize("name", ["random", "grouped", "corner", "sparse"])
def test_a_split_is_a_pure_function_of_positions_and_settings(name):
    positions = _walk()
    first = make_split(positions, SplitSettings(name))
    again = make_split(positions, SplitSettings(name))
    assert first.sha256 == again.sha256 and all(_disjoint(f, 400) for f in first.folds)
    other = make_split(positions, SplitSettings(name, seed=1))
    assert other.sha256 != first.sha256
    for fold in first.folds:
        assert len(fold.val) == pytest.approx(0.1 * (len(fold.train) + len(fold.val)), abs=1)
        assert all((np.diff(part) > 0).all() for part in (fold.train, fold.val, fold.test))


def test_random_uses_the_release_unless_redrawn():
    release = (np.arange(100), np.arange(100, 130))
    split = make_split(_walk(), SplitSettings(), release)
    np.testing.assert_array_equal(split.folds[0].test, release[1])
    np.testing.assert_array_equal(np.union1d(split.folds[0].train, split.folds[0].val), release[0])
    assert split.title == "random (test rows named by its files)"
    drawn = make_split(_walk(), SplitSettings(redraw=True), release)
    assert drawn.title == "random"
    assert len(drawn.folds[0].test) == 80 and drawn.sha256 != split.sha256
    other = make_split(_walk(), SplitSettings(redraw=True, seed=3), release)
    assert other.sha256 != drawn.sha256


def test_grouped_keeps_whole_stretches_apart():
    positions = _walk()
    split = make_split(positions, SplitSettings("grouped"))
    assert len(split.folds) == 5
    np.testing.assert_array_equal(
        np.sort(np.concatenate([f.test for f in split.folds])), np.arange(400)
    )
    for fold in split.folds:
        assert fold.test[-1] - fold.test[0] == len(fold.test) - 1
        kept = np.concatenate([fold.train, fold.val])
        gap = np.linalg.norm(positions[kept][:, None] - positions[fold.test], axis=-1)
        assert gap.min() > 0.03
        # Validation is one stretch: no training row lies between its ends along the path.
        between = (fold.train > fold.val[0]) & (fold.train < fold.val[-1])
        assert not between.any()


@pytest.mark.parametrize("corner", ["--", "-+", "+-", "++"])
def test_block_is_a_rectangle_in_a_corner(corner):
    positions = np.random.default_rng(0).uniform(0, 2, (500, 3))
    fold = make_split(positions, SplitSettings("corner", corner=corner)).folds[0]
    assert len(fold.test) == 100
    toward = np.array([1 if c == "+" else -1 for c in corner])
    centre = (positions[fold.test, :2].mean(axis=0) - 1) * toward
    assert (centre > 0.4).all()
    rest = np.concatenate([fold.train, fold.val])
    depth = np.abs(positions[:, :2] - (1 + toward)).max(axis=1)
    # The rectangle has the site's proportions, which are not exactly square.
    assert depth[rest].min() > depth[fold.test].max() - 0.01


def test_thinned_training_sets_are_nested_and_share_the_test_set():
    def train(**kwargs):
        fold = make_split(_walk(), SplitSettings(**kwargs)).folds[0]
        return set(fold.train) | set(fold.val), fold.test

    full, test = train()
    half, test_half = train(thin=0.5)
    few, test_few = train(train_count=20)
    assert few < half < full and len(half) == len(full) // 2 and len(few) == 20
    np.testing.assert_array_equal(test, test_half)
    np.testing.assert_array_equal(test, test_few)


def test_index_file_for_other_data_warns(tmp_path, caplog):
    path = tmp_path / "split.json"
    write_split(path, make_split(_walk(), SplitSettings()), rows=400, dataset_sha256="abc")
    read_split(path, rows=400, dataset_sha256="xyz")
    assert "made for other data" in caplog.text


def test_bad_index_files_are_refused(tmp_path, refused):
    path = tmp_path / "split.json"
    refused("no such split file", read_split, path, 400)
    path.write_text("[1, 2]")
    refused("not a split file", read_split, path, 400)
    write_split(path, make_split(_walk(), SplitSettings()), rows=400)
    refused("made for 400 rows, the dataset has 399", read_split, path, 399)
    content = json.loads(path.read_text())
    edits = {
        "edited or damaged": ("test", content["folds"][0]["test"][1:]),
        "names a row twice": ("test", content["folds"][0]["train"]),
        "outside 0 to 399": ("test", [400]),
    }
    for pattern, (part, rows) in edits.items():
        spoilt = json.loads(json.dumps(content))
        spoilt["folds"][0][part] = rows
        path.write_text(json.dumps(spoilt))
        refused(pattern, read_split, path, 400)


@pytest.mark.parametrize(
    "settings, pattern",
    [
        ({"name": "grouped", "folds": 1}, "folds=1: a whole number of at least 2"),
        ({"name": "groupd"}, "did you mean 'grouped'"),
        ({"val_fraction": 1.0}, "val_fraction=1.0"),
        ({"test_fraction": 0.0}, "test_fraction=0.0"),
        ({"thin": 0.0}, "thin=0.0"),
        ({"train_count": 0}, "train_count=0"),
        ({"buffer_m": float("nan")}, "buffer_m=nan"),
        ({"corner": "north"}, "corner='north'"),
    ],
)
def test_impossible_settings_are_refused(settings, pattern, refused):
    refused(pattern, SplitSettings, **settings)


def test_impossible_splits_are_refused(refused):
    refused("too few for 5 folds", make_split, _walk(8), SplitSettings("grouped"))
    refused("fold 0 has 0 training", make_split, _walk(40), SplitSettings("grouped", buffer_m=10.0))
    refused("too few to hold some out", make_split, _walk(), SplitSettings("blocks", side_m=5000))


def test_an_index_file_takes_no_setting_without_a_word(rfid_folder, tmp_path, refused):
    """`+split.leave_out` and `+split.train_count` beside split=file were ignored."""
    data, path = load_rfid(rfid_folder), str(tmp_path / "s.json")
    split = split_for({"name": "random"}, data)
    write_split(path, split, len(data), data.site.sha256)
    gone = [int(split.folds[0].train[0]), int(split.folds[0].test[0])]
    kept = split_for({"name": "file", "path": path, "leave_out": gone}, data)
    for before, after in zip(split.folds, kept.folds, strict=True):
        for part in ("train", "val", "test"):
            np.testing.assert_array_equal(
                getattr(after, part), np.setdiff1d(getattr(before, part), gone)
            )
    assert kept.sha256 != split.sha256
    with pytest.raises(
        DataError, match=r"split\.train_count: no such setting of split=file; there are"
    ):
        split_for({"name": "file", "path": path, "train_count": 5}, data)
    refused(r"split\.path is not set", split_for, {"name": "file"}, data)
    with pytest.raises(DataError, match=r"split\.leave_out: row 999 of rows 0 to"):
        split_for({"name": "file", "path": path, "leave_out": [999]}, data)


def test_thinning_by_distance_leaves_the_test_rows_alone(refused):
    positions = np.random.default_rng(0).uniform(0, 10, (600, 3)) * [1, 1, 0]
    dense, thin = (make_split(positions, SplitSettings(spacing_m=d)).folds[0] for d in (None, 0.8))
    np.testing.assert_array_equal(dense.test, thin.test)
    kept = np.concatenate([thin.train, thin.val])
    apart = np.linalg.norm(positions[kept][:, None] - positions[kept][None], axis=-1)
    assert apart[~np.eye(len(kept), dtype=bool)].min() >= 0.8
    left = np.setdiff1d(np.concatenate([dense.train, dense.val]), kept)
    assert (
        np.linalg.norm(positions[left][:, None] - positions[kept][None], axis=-1).min(1).max() < 0.8
    )
    refused("spacing_m", SplitSettings, spacing_m=0.0)


def test_blocks_are_whole_squares_until_the_share_is_reached():
    positions = np.random.default_rng(0).uniform(0, 3, (900, 3))
    fold = make_split(positions, SplitSettings("blocks", side_m=0.5, share=0.2)).folds[0]
    assert _disjoint(fold, 900) and 180 <= len(fold.test) < 180 + 60
    square = np.floor(positions[:, :2] / 0.5) @ [1, 1000]
    parts = [set(square[part]) for part in (fold.train, fold.val, fold.test)]
    assert not parts[0] & parts[1] and not parts[0] & parts[2] and not parts[1] & parts[2]
    assert len(fold.val) >= 0.1 * (len(fold.train) + len(fold.val))


@pytest.mark.parametrize("name", ["random", "grouped", "blocks", "corner"])
def test_a_place_is_held_out_for_all_stations(name):
    places = np.random.default_rng(0).uniform(0, 3, (200, 3))
    place, station = np.repeat(np.arange(200), 4), np.tile(np.arange(4), 200)
    found = make_split(places[place], SplitSettings(name), place=place, station=station)
    alone = make_split(places, SplitSettings(name))
    for fold, other in zip(found.folds, alone.folds, strict=True):
        for part in ("train", "val", "test"):
            np.testing.assert_array_equal(
                np.unique(place[getattr(fold, part)]), getattr(other, part)
            )
            assert len(getattr(fold, part)) == 4 * len(getattr(other, part))


def test_stations_are_held_out_one_by_one_or_together(refused):
    station = np.repeat(np.arange(5), 20)
    positions = np.random.default_rng(0).uniform(0, 3, (100, 3))
    split = make_split(positions, SplitSettings("stations"), station=station)
    assert [set(station[fold.test]) for fold in split.folds] == [{t} for t in range(5)]
    for fold in split.folds:
        assert _disjoint(fold, 100) and len(set(station[fold.val])) == 1
        assert not set(station[fold.val]) & set(station[fold.train])
    (fold,) = make_split(positions, SplitSettings("stations", leave_out=2), station=station).folds
    assert len(set(station[fold.test])) == 2
    refused("have one station", make_split, positions, SplitSettings("stations"))
    with pytest.raises(DataError, match="two at least must remain"):
        make_split(positions, SplitSettings("stations", leave_out=4), station=station)


def test_whole_runs_are_held_out(refused):
    run = np.repeat([3, 4, 7, 8, 9], 20)
    positions = np.random.default_rng(0).uniform(0, 3, (100, 3))
    (fold,) = make_split(positions, SplitSettings("runs"), station=run).folds
    assert [len(set(run[part])) for part in (fold.train, fold.val, fold.test)] == [3, 1, 1]
    assert _disjoint(fold, 100)
    (fold,) = make_split(positions, SplitSettings("runs", test_fraction=0.4), station=run).folds
    assert len(set(run[fold.test])) == 2
    inner = inner_folds(positions, fold, SplitSettings("runs", test_fraction=0.4), 3, 0, None, run)
    assert inner.name == "runs" and all(len(set(run[one.test])) == 1 for one in inner.folds)
    refused("have one run; take split=random", make_split, positions, SplitSettings("runs"))


PLACES = np.repeat(np.random.default_rng(0).uniform(0, 9, (30, 3)), 10, axis=0)
POST = np.array([0.0, 0, 5])


@pytest.mark.parametrize(
    "other_end",
    [
        {},
        {"tx_position": POST},
        {"station_position": np.add.outer([0, 9], POST)},
        {"tx_position": np.roll(PLACES, -10, 0)},
    ],
    ids=["unknown", "one", "two", "moves"],
)
def test_a_place_visited_again_was_learned_from_and_tested_on(other_end):
    """Ten samples at each of 30 places: every test row had others of its place to learn from."""
    levels = -60 - PLACES[:, 0]
    levels = levels[:, None] - [0, 3] if "station_position" in other_end else levels
    data = from_arrays({"rx_position": PLACES, "rssi_db": levels, **other_end})
    for name in ("random", "sparse"):
        fold = split_for({"name": name}, data).folds[0]
        known = {tuple(row) for row in data.moving[np.concatenate([fold.train, fold.val])]}
        assert len(fold.test) and not known & {tuple(row) for row in data.moving[fold.test]}


@pytest.mark.parametrize("apart", [1e-9, 1e-6, 1e-3, 1e-2])
@pytest.mark.parametrize("visits", [2, 12])
def test_places_visited_again_within_a_hundredth_of_the_step_were_split_apart(
    apart, visits, caplog
):
    """.63 dB where 3.92 was right: what was tested had been learned a millimetre away."""
    caplog.set_level("INFO")
    rng = np.random.default_rng(1)
    place = np.repeat(rng.uniform(0, 60, (60, 3)) * [1, 1, 0.02], visits, axis=0)
    aside = rng.normal(size=place.shape)
    places = place + aside * (apart / 2 / np.linalg.norm(aside, axis=1, keepdims=True))
    places[-1] += 1e5  # one far outside
    data = from_arrays(
        {"rx_position": places, "tx_position": POST, "rssi_db": -60 - rng.normal(size=len(places))}
    )
    for name in ("random", "sparse", "blocks"):
        fold = split_for(
            {"name": name, **({"side_m": 9.0} if name == "blocks" else {})}, data
        ).folds[0]
        inner = inner_folds(data.moving, fold, SplitSettings(name, side_m=9.0), 2, 0).folds[0]
        for one in (fold, inner):
            known, unseen = (
                data.moving[part] for part in (np.concatenate([one.train, one.val]), one.test)
            )
            assert np.linalg.norm(known[:, None] - unseen, axis=-1).min() > 0.02
    assert (
        f"{60 * visits} rows are of 61 places: those within a hundredth of the usual step"
    ) in caplog.text


@pytest.mark.parametrize("side_m", [None, 0.3, 0.5])
def test_squares_moved_with_the_place_of_the_station(side_m):
    """The same places with the station elsewhere were tested on 74 or on 66 rows."""
    rng, tests = np.random.default_rng(2), []
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(15), [12]), -1).reshape(-1, 3) / 10
    for places in (rng.uniform(0, 3, (300, 3)), grid):
        for station in ([0.1, 0.2, 2], [9.7, 3.3, 2], [-100.37, 7, 2]):
            given = {
                "rx_position": places,
                "tx_position": np.array(station),
                "rssi_db": rng.normal(size=300),
            }
            data = from_arrays(given)
            split = split_for({"name": "blocks", "side_m": side_m, "seed": 4}, data)
            inner = inner_folds(
                data.moving, split.folds[0], SplitSettings("blocks", side_m=side_m), 2, 0
            )
            tests.append(
                [*(part.tolist() for part in vars(split.folds[0]).values()), inner.unit.tolist()]
            )
    assert tests[0] == tests[1] == tests[2] and tests[3] == tests[4] == tests[5]
    assert 60 <= len(tests[0][2]) < 90


def test_splits_of_shared_data_keep_their_rows():
    """Nothing there is visited again; a split of a stored run is made anew from its settings."""
    known = {
        "newrf": ("newrf-conference.npz", "9f065a7d9d52"),
        "ble": ("real/ble-hall-1.npz", "cf4cbac73801"),
    }
    for name, (file, sha256) in known.items():
        found = split_for({"name": "random"}, load({"name": name, "file": str(real(file))})).sha256
        assert found.startswith(sha256)


def test_a_survey_whose_transmitters_were_rarely_heard_had_no_table(caplog):
    """A dozen access points at unknown places, some heard twice:
    every baseline refused its test rows.
    """
    rng, heard = np.random.default_rng(0), [60, 40, 20, 3, 2, 1]
    spots = rng.uniform(0, 50, (60, 2)).tolist()
    rows = [
        (*spots[i], t)
        for t, count in enumerate(heard)
        for i in rng.choice(60, count, replace=False)
    ]
    x, y, station = np.array(rows).T
    arrays = {
        "rx_position": np.stack([x, y, np.ones(len(x))], 1),
        "station": station.astype(int),
        "station_position": np.full((6, 3), np.nan),
        "rssi_db": rng.normal(-70, 5, len(x)),
    }
    data = from_arrays(arrays)
    split = split_for({"name": "random", "test_fraction": 0.4}, data)
    (fold,) = split.folds
    assert set(data.station[fold.test]) == {0, 1, 2} and {3, 4} & set(data.station[fold.train])
    assert "test rows are left out, of stations with under 4 training rows" in caplog.text
    assert split.sha256 == hash_indices(split.folds)
    for name in ("zero", "gp", "kriging"):
        wrap_per_station(method_class(name)(), data).fit(data, fold, FitContext(Path()))
    placed = from_arrays({**arrays, "station_position": rng.uniform(0, 50, (6, 3))})
    asked = split_for({"name": "random", "test_fraction": 0.4}, placed).folds[0].test
    assert len(asked) > len(fold.test)  # at known places they are predicted
    # Nothing else is asked: methods say that they cannot.
    assert all(len(one.test) for one in split_for({"name": "stations"}, data).folds)


@pytest.mark.parametrize("side_m", [None, 3.0])
def test_places_of_a_lift_were_told_to_take_smaller_squares(side_m):
    lift = np.tile([2.5, 4.0, 0.0], (40, 1)) + np.linspace(0, 60, 40)[:, None] * [0, 0, 1]
    with pytest.raises(
        DataError, match="all positions are one above the other, there are no squares"
    ):
        make_split(lift, SplitSettings("blocks", side_m=side_m))


def test_later_tests_on_the_rows_that_were_taken_last_at_any_place():
    rng = np.random.default_rng(0)
    positions, taken = np.repeat(rng.uniform(0, 9, (25, 3)), 4, 0), rng.permutation(100)
    place = np.repeat(np.arange(25), 4)
    (fold,) = make_split(
        positions, SplitSettings("later", leave_out=[5]), place=place, order=taken
    ).folds
    last = np.setdiff1d(np.argsort(taken), [5], assume_unique=True)[-20:]
    assert set(fold.test) == set(last) and 5 not in np.r_[fold.train, fold.val]
    assert len(fold.train) + len(fold.val) == 79
    (fold,) = make_split(positions, SplitSettings("later", test_fraction=0.1)).folds
    assert fold.test.tolist() == [*range(90, 100)]  # as they stand in the file


def _links(rows=600, stations=12):
    rng = np.random.default_rng(3)
    arrays = {
        "rx_position": rng.uniform(0, 10, (rows, 3)),
        "station_position": rng.uniform(0, 10, (stations, 3)),
        "station": np.arange(rows) % stations,
        "rssi_db": rng.normal(-60, 5, rows),
    }
    return from_arrays(arrays, {"name": "links"})


def test_no_training_row_has_an_end_that_is_new():
    data, settings = _links(), {"name": "stations", "leave_out": 3, "side_m": 2.0}
    (alone,), (fold,) = (split_for({**settings, "end": e}, data).folds for e in (None, "both"))
    assert set(fold.test) < set(alone.test) and set(fold.learned()) < set(alone.learned())
    assert set(data.station[fold.test]).isdisjoint(data.station[fold.learned()])
    shifted = data.moving - data.moving.min(0)
    square = np.unique(shifted[:, :2] // 2, axis=0, return_inverse=True)[1].reshape(-1)
    assert set(square[fold.test]).isdisjoint(square[fold.learned()])


def test_an_end_that_is_new_is_a_station_or_a_square():
    data, settings = _links(), {"name": "stations", "leave_out": 3}
    still = split_for({**settings, "end": "tx"}, data)
    assert still.sha256 == split_for(settings, data).sha256
    moving = split_for({**settings, "end": "rx"}, data)
    assert moving.sha256 == split_for({"name": "blocks"}, data).sha256
    with pytest.raises(DataError, match="split=stations takes it"):
        SplitSettings("random", end="both")


def test_folds_inside_know_both_ends():
    data = _links()
    settings = SplitSettings("stations", leave_out=3, end="both")
    fold = split_for({"name": "stations", "leave_out": 3, "end": "both"}, data).folds[0]
    inner = inner_folds(data.moving, fold, settings, 2, seed=0, station=data.station)
    assert all(len(part.train) and len(part.test) for part in inner.folds)
    assert inner.name == "stations"
