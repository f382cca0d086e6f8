"""Later rows are checked as first rows are, and against the model that is told of them."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused, refused_as
from rooms_later import PLACES, SCREENED, levels

import gsparc
from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.prediction.later_rows import ABOVE_DB
from gsparc.prediction.updating import ToldBefore, versions_extra

AT, LEVELS = SCREENED[:3], [-60.0, -61.0, -62.0]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    file = tmp_path_factory.mktemp("room") / "model.ckpt"
    gsparc.fit(rx=PLACES, rssi=levels(PLACES, 0), tx=[9.0, 9.0, 2.6], model="gp", save=file)
    return file


@pytest.fixture
def predictor(fitted):
    return gsparc.load(fitted)


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    masts = np.array([[0.0, 0, 3], [20, 0, 3], [0, 20, 3]])
    heard = np.stack([levels(PLACES, k) for k in range(3)], axis=1)
    return gsparc.fit(rx=PLACES, rssi=heard, station_position=masts, model="gp")


@pytest.mark.parametrize(
    "rssi, says",
    [
        (np.full((3, 2), -60.0), r"here \(2, 3\), found \(3, 2\); transposed\?"),
        ([-60.0] * 6, r"here \(2, 3\), found \(6,\)"),
        ([[-60.0] * 2, [-60.0] * 3], "row 1: holds 3 numbers, others 2"),
        ([], r"shape \(0,\) holds nothing"),
        ([[], []], r"shape \(2, 0\) holds nothing"),
        ([["a"] * 3] * 2, "expected real numbers"),
        ([[None] * 3] * 2, "nothing was measured"),
    ],
)
def test_levels_of_another_shape_were_told_as_if_they_were_of_this_one(three, rssi, says):
    refused(says, three.update, rx=SCREENED[:2], rssi=rssi)
    assert not len(three.rows)


@pytest.mark.parametrize("level", [400.0, 1e300, np.inf, -1e300, 80.0])
def test_a_level_that_no_receiver_reads_is_refused_with_its_row(predictor, level):
    refused("row 1: ", predictor.update, rx=AT, rssi=[-60.0, level, -62.0])
    assert not len(predictor.rows)


def test_a_level_as_far_above_the_mean_as_receivers_span_is_taken(predictor):
    assert ABOVE_DB < 180
    assert len(predictor.update(rx=AT, rssi=[-60.0, 50.0, -170.0]).rows) == 3


def test_silence_tells_nothing_and_is_counted(predictor):
    found = predictor.update(rx=AT, rssi=[-60.0, -np.inf, np.nan])
    assert len(found.rows) == 1 and found.skipped == 1
    refused(
        "row 2: out of range; expected linear power",
        predictor.update,
        rx=AT,
        rssi=[1, 1, -1],
        unit="linear",
    )


@pytest.mark.parametrize(
    "places, says",
    [
        (AT + np.array([1e6, 0, 0]), "rows 0 to 2: 1000 km from the middle of the model's rows"),
        (np.r_[AT[:2], AT[2:] + np.array([0, 500, 0])], "row 2: 0.4955 km from the middle"),
        (AT / 1e3, "rows 0 to 2: .* in kilometres"),
        (AT[:1] / 1e3, "row 0: .* in kilometres"),
        (SCREENED[:30] / [1e3, 1e3, 1], "rows 0 to 29: .* in kilometres"),
        (AT * [1, np.nan, 1], "row 0 = "),
        (AT[:, :2], r"found \(3, 2\)"),
        (np.zeros((0, 3)), "holds nothing"),
    ],
)
def test_places_that_no_row_of_the_model_can_be_at_are_refused(predictor, places, says):
    refused(says, predictor.update, rx=places, rssi=np.full(len(places), -60.0))


def test_places_beside_those_of_the_model_and_one_that_stands_still_are_taken(predictor):
    beside = AT + np.array([60.0, 0, 0])
    still = PLACES[:1] + np.random.default_rng(0).normal(0, 0.003, (20, 3))
    assert len(predictor.update(rx=beside, rssi=LEVELS).rows) == 3
    assert len(predictor.update(rx=still, rssi=[-60.0] * 20).rows) == 20


@pytest.mark.parametrize(
    "name, value",
    [
        ("false_alarm", 0),
        ("false_alarm", np.inf),
        ("window", 1.5),
        ("window", 0),
        ("refit", "yes"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_in_python_as_on_the_command_line(
    predictor, name, value
):
    refused(f"{name}={value!r}: ", predictor.update, rx=AT, rssi=LEVELS, **{name: value})


def test_what_is_no_number_of_rows_or_decibels_is_refused(predictor):
    predictor.update(rx=AT, rssi=LEVELS)
    for rows in (np.nan, [0.5], "a"):
        refused("whole numbers are needed", predictor.forget, rows)
    refused("count=1.5", predictor.undo, 1.5)
    refused(
        "not fitted yet",
        type(predictor)(type(predictor.method.inner)(), predictor.site).update,
        rx=AT,
        rssi=LEVELS,
    )


def test_rows_of_a_key_are_taken_once_until_they_are_undone(predictor, tmp_path):
    predictor.update(rx=AT, rssi=LEVELS, key="monday")
    predictor.update(rx=AT, rssi=LEVELS)  # one that stands still repeats
    refused_as(
        ToldBefore, "monday was told before", predictor.update, rx=AT, rssi=LEVELS, key="monday"
    )
    assert len(predictor.rows) == 6
    predictor.undo(2)
    assert len(predictor.update(rx=AT, rssi=LEVELS, key="monday").rows) == 3


def _rows(stored):
    return stored[-1]["state"]["changes"]["state"]["rows"][0][1]["state"]


def _set(part, name, value):
    part[name] = value(part[name]) if callable(value) else value


@pytest.mark.parametrize(
    "damage",
    [
        lambda stored: _set(_rows(stored), "missed", lambda part: part * np.nan),
        lambda stored: _set(_rows(stored), "missed", lambda part: part[:2]),
        lambda stored: _set(_rows(stored), "places", lambda part: part[:, :1]),
        lambda stored: _rows(stored).pop("missed"),
        lambda stored: _set(stored[-1]["state"]["changes"]["state"], "rows", 5),
        lambda stored: _set(stored[-1]["state"], "watch", 5),
        lambda stored: _set(stored, 0, {}),
        lambda stored: _set(stored, -1, "later"),
    ],
)
def test_damaged_later_rows_of_a_checkpoint_are_said(fitted, predictor, damage):
    predictor.update(rx=AT, rssi=LEVELS)
    extra = versions_extra(predictor.versions)
    damage(extra["updates"])
    stored = checkpoint.read(fitted)
    refused_as(
        CheckpointError, "later rows", gsparc.load, replace(stored, extra=stored.extra | extra)
    )
