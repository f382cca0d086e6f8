"""Errors of powers by station, the strongest station at a place,
and leads with and without silent rows.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from gsparc.data.splits import Fold, Split
from gsparc.evaluation.by_station import (
    describe_new,
    newly_listed,
    rmse_after_constants,
    score_best_server,
    worst_stations,
)
from gsparc.evaluation.metric_formats import BEST_SERVER, OF_LISTS, WITHOUT_OFF
from gsparc.evaluation.scores import Scores
from gsparc.evaluation.summary import remarks, results_table
from gsparc.models.method import Method, Prediction
from gsparc.prediction.timing import ClockSettings
from gsparc.runs.align_site import align_to_site
from gsparc.runs.baselines import fit_baseline
from gsparc.runs.evaluate import evaluate
from gsparc.tables.own import from_arrays

PLACES, NAMES = 60, ["north", "south", "roof"]


@pytest.fixture(scope="module")
def drive():
    """60 places along a line, three stations, the second of which scatters by 8 dB."""
    rng = np.random.default_rng(1)
    place, station = np.repeat(np.arange(PLACES), 3), np.tile(np.arange(3), PLACES)
    level = (
        -60
        - 0.1 * place
        - 10.0 * station
        + rng.normal(size=3 * PLACES) * np.where(station == 1, 8, 0.5)
    )
    return listed(place, station, level)


def listed(place, station, level):
    """Levels of three stations beside a line."""
    arrays = {
        "rx_position": np.c_[place, np.zeros((len(place), 2))].astype(float),
        "station": station,
        "station_position": np.array([[0.0, 9, 5], [30, 9, 5], [59, 9, 5]]),
        "rssi_db": level,
        "station_name": np.array(NAMES),
    }
    return from_arrays(arrays, {"absent": "unknown"})


def split_of(data, tested=5):
    test = data.place % tested == 1
    rows = np.arange(len(data))
    return Split("every fifth", (Fold(rows[~test], rows[:0], rows[test]),))


def evaluated(data, baselines):
    split = split_of(data)
    quick = ClockSettings(rounds=3, least=2, warmup=1)
    return evaluate(
        fit_baseline("nearest", data, split).methods,
        1.0,
        data,
        split,
        baselines=baselines,
        clock=quick,
    )


def test_errors_of_single_stations_were_nowhere(drive, tmp_path):
    """A planner saw one rmse for all stations, and not which row of per_sample.csv was of which."""
    found = evaluated(drive, ["mean", "idw"])
    found.write(tmp_path, run_id="one")
    samples, stations = (
        pd.read_csv(tmp_path / f"{name}.csv") for name in ("per_sample", "by_station")
    )
    assert list(stations["station"]) == NAMES and set(samples["station"]) == set(NAMES)
    own = samples.groupby("station")["error_db"]
    rmse = own.apply(lambda error: np.sqrt(np.mean(error**2)))[NAMES]
    assert stations["rows"].tolist() == [12, 12, 12]
    np.testing.assert_allclose(stations["rmse_db"], rmse)
    np.testing.assert_allclose(stations["bias_db"], own.mean()[NAMES])
    assert stations["baseline/idw/rmse_db"].idxmax() == 1 and "baseline/mean/bias_db" in stations
    (worst,) = worst_stations(found.stations, "nearest")
    heads, rows = worst.texts()
    assert heads == ["station", "rows", "nearest", "bias_db of nearest", "mean", "idw"]
    assert rows[0][:2] == ["south", "12"] and len(rows) == 3
    ahead = [
        int((stations["rmse_db"] < stations[f"baseline/{one}/rmse_db"]).sum())
        for one in ("mean", "idw")
    ]
    better = f"than mean at {ahead[0]}, than idw at {ahead[1]}"
    assert worst.note == f"nearest has the smaller rmse_db {better} of 3 stations (10 rows or more)"
    heads, rows = results_table(found.facts, "nearest").texts()
    assert rows[-1][heads.index("best_server")] == f"{found.facts['test/best_server']:.1%}"


def test_a_method_was_better_than_itself_at_none_of_the_stations():
    """`gp is better than gp at 0`, beside a second column of the same figures."""
    rows = {"station": ["a", "b"], "rows": [12, 12], "rmse_db": [5.0, 4.0], "bias_db": [1.0, 1.0]}
    baselines = {f"baseline/{name}/rmse_db": [5.0, 6.0] for name in ("zero", "gp", "idw")}
    (worst,) = worst_stations({**rows, **baselines}, "gp")
    assert worst.note == "gp has the smaller rmse_db than idw at 1 of 2 stations (10 rows or more)"
    assert worst.texts()[0] == ["station", "rows", "gp", "bias_db of gp", "idw"]


def test_a_cell_that_lost_ten_decibels_was_said_to_need_another_baseline():
    columns = {
        "station": ["A", "B"],
        "rows": [40, 40],
        "rmse_db": [3.0, 11.7],
        "bias_db": [0.2, 11.3],
    }
    (worst,) = worst_stations(columns, "gsparc")
    assert worst.note == "measured levels differ from predicted by one offset: B (-11.3 dB)"
    (worst,) = worst_stations(columns, "gsparc", later=True)
    assert worst.note.endswith(
        "B (-11.3 dB): gsparc update learns that, but not from lists of the strongest"
    )


def test_the_worst_stations_had_other_names_than_warnings_and_a_bias_of_no_meaning():
    """`150` of `W03-2 (150)`, and -3.5 dB that was the choice of heard rows,
    which are judged as such now.
    """
    rows = {"rows": [12, 12], "rmse_db": [5.0, 4.0], "bias_db": [-3.5, -1.0]}
    columns = {"station": ["150", "212"], "cell": ["W03-2", "212"], **rows}
    (listed,) = worst_stations({**columns, "rows_with_silent": [12, 40]}, "gp")
    assert [row[0] for row in listed.texts()[1]] == ["W03-2 (150)", "212"] and not listed.note


def scored(data, prediction, error=None):
    rows = np.arange(len(data))
    target = data.target[:, 0].astype(float)
    if data.censored is not None:
        target[data.censored > 0] = np.nan
    samples = {"prediction": np.asarray(prediction, float), "target": target, "error_db": error}
    return Scores("rssi", 0 * rows, rows, samples, rows * np.nan, rows * np.nan)


def test_the_strongest_is_told_where_it_is_and_equal_answers_tell_nothing(drive):
    """Lists begin with the strongest: equal answers, as of `zero`,
    would be right by their order.
    """
    truth = drive.target[:, 0].astype(float)
    assert score_best_server(scored(drive, truth), drive) == {"best_server": 1.0}
    assert score_best_server(scored(drive, -truth), drive) == {"best_server": 0.0}
    assert score_best_server(scored(drive, 0 * truth), drive)["best_server"] == pytest.approx(1 / 3)
    assert score_best_server(scored(drive, truth), replace(drive, station=None)) == {}
    # Each visit to a place names its station again: one right answer, not half of one.
    twice = replace(drive, place=drive.place // 2)
    strongest = np.array(
        [
            truth[(twice.place == p) & (twice.station == t)].max()
            for p, t in zip(twice.place, twice.station, strict=True)
        ]
    )
    assert score_best_server(scored(twice, strongest), twice) == {"best_server": 1.0}


def test_a_saturated_station_was_never_the_strongest():
    """It reports its most, -50 dB, at every second place:
    right predictions were right at half of them.
    """
    place, station = np.repeat(np.arange(PLACES), 3), np.tile(np.arange(3), PLACES)
    level = np.where(
        station == 0, np.where(place % 2, -80 - 0.1 * place, -50), -60 - 0.1 * place - station
    )
    data = listed(place, station, level)
    assert (data.censored == -1).sum() == PLACES // 2
    truth = data.target[:, 0].astype(float)
    scores = scored(data, truth)
    scores.samples["target"] *= np.where(data.censored == 0, data.site.target_scale, np.nan)
    assert score_best_server(scores, data) == {"best_server": 1.0}


def test_errors_equal_at_each_station_ended_in_nan(drive):
    """A root of rounding below 0 ended `split=stations` after training: a summary takes no NaN."""
    for seed in range(9):
        error = np.random.default_rng(seed).normal(0, 10, 3)[drive.station]
        assert rmse_after_constants(scored(drive, error, error), drive.station) == pytest.approx(
            0, abs=1e-6
        )


def test_stations_of_an_earlier_evaluation_stayed_in_the_folder(drive, tmp_path):
    """Another of one station left `by_station.csv` of other data beside its own figures."""
    found = evaluated(drive, [])
    found.write(tmp_path)
    replace(found, stations={}).write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["per_sample.csv"]


def test_a_lead_with_silent_rows_hid_a_loss_on_heard_ones():
    """`gsparc` was called better than all baselines,
    where kriging had 4.30 for 4.94 dB of heard rows.
    """
    facts = {
        "dataset/kind": "rssi",
        "model/label": "gsparc",
        "test/rmse_db": 4.94,
        "test/rmse_db_with_silent": 3.0,
        "baseline/kriging/rmse_db": 4.30,
        "baseline/kriging/rmse_db_with_silent": 4.0,
        "baseline/kriging/ahead_db": -1.0,
        "baseline/kriging/ahead_error_db": 0.1,
        "baseline/kriging/ahead_pairs": "900 test rows",
        "baseline/kriging/ahead_listed_db": 0.64,
        "baseline/kriging/ahead_listed_error_db": 0.1,
        "baseline/kriging/ahead_listed_pairs": "300 test rows",
    }
    assert remarks(facts) == [
        "gsparc is 1.00 ± 0.10 (standard error) dB better over 900 test rows in "
        "rmse_db_with_silent "
        "than kriging, the best baseline",
        "the baseline kriging is 0.64 ± 0.10 (standard error) dB better over 300 test rows "
        "in rmse_db of heard rows",
    ]


def test_the_strongest_at_the_nearest_moment_was_in_no_table():
    """Levels of each station's own nearest moments tell a best server worse:
    52 for 63 % of a drive.
    """
    near = listed([0, 10, 20, 30], [0, 1, 1, 0], [-70.0, -75, -75, -70])
    rows = np.arange(4)
    split = Split("own", (Fold(rows, rows[:0], rows),))
    asked = listed([9, 9, 1, 1], [0, 1, 0, 1], [-90.0, -76, -71, -95])
    own = Split("asked", (Fold(rows[:0], rows[:0], rows),))
    scores = fit_baseline("nearest", asked, own, learned=(near, split)).scores
    assert score_best_server(scores, asked) == {"best_server": 1.0}
    del scores.samples["served"]
    assert score_best_server(scores, asked) == {"best_server": 0.5}


MASTS, TRUE_DB = np.array([[100.0 * t, 30.0, 20.0] for t in range(8)]), 4.0


class TrueLaw(Method):
    """Knows how levels of every mast fall, and how they scatter."""

    name, uses_censored = "law", True

    def __init__(self, site):
        self.site = site

    def predict(self, query):
        places = query.places(self.site)[:, :3]
        level = law_db(places.numpy() + self.site.origin)[np.arange(len(places)), query.station]
        mean = torch.from_numpy(10 ** (level / 10) / self.site.target_scale)[:, None]
        return Prediction(mean, (mean[:, 0] * np.log(10) / 10 * TRUE_DB) ** 2)

    fit = state = restore = None


def law_db(places):
    return -20 - 35 * np.log10(np.linalg.norm(places[:, None] - MASTS, axis=-1))


def lists_along(seed, off=()):
    """Lists of the three strongest of eight masts at 400 places along a street."""
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(0, 700, 400), rng.uniform(-5, 5, 400), np.full(400, 1.5)]
    level = law_db(place) + TRUE_DB * rng.normal(size=(400, 8))
    level[:, list(off)] = -np.inf
    moment, station = np.nonzero(np.argsort(np.argsort(-level, 1), 1) < 3)
    arrays = {
        "rx_position": place[moment],
        "station": station,
        "station_position": MASTS,
        "rssi_db": level[moment, station],
    }
    return from_arrays(arrays)


def test_a_station_that_is_new_is_told_from_one_that_was_out_of_reach():
    later = lists_along(1)
    found = newly_listed(lists_along(0, (3,)), align_to_site(later, lists_along(0).site))
    assert found.index.tolist() == [3] and found.chance[3] < 1e-6
    assert 0.5 * found.lists[3] < found.expected[3] < 1.2 * found.lists[3]
    first = lists_along(0)
    near = first.subset(np.flatnonzero(first.moving[:, 0] < 0))  # half of the street
    unsure = newly_listed(near, later)
    assert len(unsure) and (unsure.chance == 1).all()
    assert "new, or out of its reach before; chance 1e+00" in describe_new(near, later)
    assert newly_listed(first, later).empty and describe_new(first, later) is None


def test_figures_of_a_drive_counted_cells_that_were_off():
    """Rows of the others are judged given that dead cells fill lists, whose own rows count."""
    learned, judged = lists_along(0), lists_along(1, (3, 4))
    rows, none = np.arange(len(judged)), np.zeros(0, int)
    whole, taught = (
        Split("", (Fold(*parts),))
        for parts in ((none, none, rows), (np.arange(len(learned)), none, none))
    )
    facts = evaluate(
        TrueLaw(learned.site),
        None,
        align_to_site(judged, learned.site),
        whole,
        baselines=["idw"],
        learned=(learned, taught),
        timed=False,
    ).facts
    for figure in OF_LISTS[:2]:
        assert facts[f"test/{figure}{WITHOUT_OFF}"] < facts[f"test/{figure}"] - 0.1
    assert facts[f"test/{BEST_SERVER}{WITHOUT_OFF}"] >= facts[f"test/{BEST_SERVER}"]
    lead = facts["baseline/idw/ahead_db"] - facts[f"baseline/idw/ahead{WITHOUT_OFF}_db"]
    assert abs(lead) > 0.1  # dead cells decided which method is better
    text = "\n".join(remarks(facts))
    assert f"figures above count these cells; without them: {OF_LISTS[0]} " in text
    assert f", {BEST_SERVER} {facts[f'test/{BEST_SERVER}{WITHOUT_OFF}']:.1%}" in text
    assert "without cells that may be off: " in text
