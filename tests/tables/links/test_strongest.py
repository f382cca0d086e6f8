"""Lists of the strongest: recognised, what they leave out, and levels of single rows."""

import numpy as np
import pytest
from networks import network
from releases import release

from gsparc.base.errors import DataError, Severe
from gsparc.datasets.powder import read_powder
from gsparc.tables.own import from_arrays, interpret
from gsparc.tables.raw import Raw


@pytest.mark.parametrize("count", [3, 10])
def test_lists_of_the_strongest_tell_of_what_they_leave_out(count):
    one = network(0)
    reading = interpret(Raw(one.arrays(count, azimuths=False)), "drive")
    data = reading.data
    said = [
        note for note in reading.notes if note.startswith(f"lists of the {count} strongest of 30")
    ]
    silent, listed = data.censored > 0, data.censored == 0
    assert len(said) == 1 and listed.sum() == 700 * count and silent.sum() <= 2 * listed.sum()
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    place = {tuple(at): i for i, at in enumerate(one.moment.round(3))}
    moment = [place[tuple(at)] for at in (data.moving + data.site.origin).round(3)]
    truth = one.measured[moment, data.station]
    assert np.allclose(truth[listed], level[listed], atol=1e-3)
    assert (truth[silent] < level[silent] + 1e-3).all()


def test_lists_that_a_receivers_limit_cuts_were_no_lists():
    """A sixth of the moments was full, and what these left out was taken as below the limit."""
    one = network(0)
    keep = one.listed(5) & (one.measured > np.quantile(one.measured[one.listed(5)], 0.4))
    full = keep.sum(1) == 5
    assert 0.15 < full.mean() < 0.3
    moment, cell = np.nonzero(keep)
    arrays = one.arrays(5, azimuths=False) | {
        "rx_position": one.moment[moment],
        "station": cell,
        "rssi_db": one.measured[moment, cell],
    }
    reading = interpret(Raw(arrays), "drive")
    assert any(
        note.startswith("lists of the 5 strongest of 30 stations: ") for note in reading.notes
    )
    limit = one.measured[moment, cell].min()
    bound = 10 * np.log10(reading.data.target[:, 0] * reading.data.site.target_scale)
    assert (bound[reading.data.censored > 0] > limit + 1e-3).any()


def test_stations_that_no_floor_hides_were_left_out_in_silence():
    """Of 3,084 missing levels 2,537 were used, all of another station unknown,
    and no line named it.
    """
    one, rng = network(0), np.random.default_rng(0)
    heard = one.measured > np.quantile(one.measured, 0.6)
    heard[:, 20] &= rng.random(len(heard)) > 0.1
    moment, cell = np.nonzero(heard)
    arrays = one.arrays(6, azimuths=False) | {
        "rx_position": one.moment[moment],
        "station": cell,
        "rssi_db": one.measured[heard],
    }
    notes = interpret(Raw(arrays), "drive").notes
    assert any("weak ones alone" in note and "but of 6-2 unknown" in note for note in notes), notes


def test_lists_with_unknown_absent_cells_looked_better_than_they_were():
    """Listed rows were off by 2.97 dB, with unlisted ones by 3.50; all cells by 9.02 and 6.30."""
    reading = interpret(Raw(network(0).arrays(6), {"absent": "unknown"}), "drive")
    severe = [note for note in reading.notes if isinstance(note, Severe)]
    assert reading.data.censored is None and len(severe) == 1
    assert severe[0].startswith(
        "lists of the 6 strongest of 30 stations with dataset.absent=unknown: "
    )


@pytest.mark.parametrize("floor", [False, True])
def test_check_advised_silent_beside_leave_absent_out(floor):
    """Beside the one advice stood `say dataset.absent=silent`,
    and outages of what lists leave out.
    """
    arrays = network(0).arrays(6)
    if floor:
        one = network(0)
        moment, cell = np.nonzero(one.measured > np.quantile(one.measured, 0.6))
        arrays |= {
            "rx_position": one.moment[moment],
            "station": cell,
            "rssi_db": one.measured[moment, cell],
        }
    reading = interpret(Raw(arrays, {"absent": "unknown"}), "drive")
    (said,) = [note for note in reading.notes if isinstance(note, Severe)]
    assert "with dataset.absent=unknown: " in said and said.endswith("; leave absent out")


def test_silent_cells_of_a_wide_table_were_lost():
    """`absent=silent` was for files of links alone; of a wide one it was ignored."""
    one = network(0, moments=60)
    keep = one.listed(6)
    keep[:, 4], keep[7] = False, False  # a cell that was never heard, a place where none was
    level = np.where(keep, one.measured, np.nan)
    moment, cell = np.nonzero(keep)
    posts = {"station_position": one.place}
    wide = {"rx_position": one.moment, "rssi_db": level} | posts
    long = {"rx_position": one.moment[moment], "station": cell, "rssi_db": level[keep]} | posts
    for arrays in (wide, long):
        data = interpret(Raw(arrays, {"absent": "silent"}), "drive").data
        assert len(data) == 59 * 30 and (data.censored > 0).sum() == 59 * 30 - keep.sum()
        assert (data.censored[data.station == 4] > 0).all()
    with pytest.raises(DataError, match=r"expected shape \(S,\) or \(S, T\)"):  # was a traceback
        interpret(Raw(long | {"rssi_db": level[keep][:, None]}, {"absent": "silent"}), "drive")


def test_outages_are_no_lists():
    raw = read_powder(release("real/powder-rss-462mhz.npz"))
    assert interpret(raw, "powder").data.censored is None


def test_rows_have_levels_of_their_own():
    """A column of levels was refused, as one for all rows was expected."""
    levels = np.array([-70.0, np.nan, -75.0, np.nan, -80.0])
    floor = np.array([np.nan, -90.0, -99.0, -95.0, -99.0])
    data = from_arrays(
        {
            "rx_position": np.eye(5, 3) * 9,
            "tx_position": np.zeros(3),
            "rssi_db": levels,
            "sensitivity_db": floor,
        }
    )
    found = 10 * np.log10(data.target[data.censored > 0, 0] * data.site.target_scale)
    assert np.allclose(found, [-90, -95], atol=1e-4)


@pytest.mark.parametrize("wide", [False, True])
def test_cells_below_a_floor_were_taken_for_lost(wide):
    """Of a row for each heard cell `check` said good,
    and weak cells were predicted 10 dB too high.
    """
    one = network(0)
    heard = one.measured > np.quantile(one.measured, 0.6)
    moment, cell = np.nonzero(heard)
    arrays = {"rx_position": one.moment, "station_position": one.place}
    arrays |= {"rssi_db": np.where(heard, one.measured, np.nan)}
    if not wide:
        arrays |= {
            "rx_position": one.moment[moment],
            "station": cell,
            "rssi_db": one.measured[heard],
        }
    reading = interpret(Raw(arrays), "drive")
    silent, station = reading.data.censored > 0, reading.data.station
    assert [
        note.startswith("levels are missing beside weak ones alone") for note in reading.notes
    ].count(True)
    assert heard.sum() < silent.sum() <= 2 * heard.sum()
    level = 10 * np.log10(reading.data.target[:, 0] * reading.data.site.target_scale)
    place = {tuple(at): i for i, at in enumerate(one.moment.round(3))}
    of = [place[tuple(at)] for at in (reading.data.moving + reading.data.site.origin).round(3)]
    assert (one.measured[of, station] < level + 1e-3)[silent].all()
    assert interpret(Raw(arrays, {"absent": "unknown"}), "drive").data.censored is None


def test_noise_in_lists_of_the_strongest_was_refused():
    one, listed = network(0), network(0).listed(6)
    arrays = one.arrays(6)
    floor = float(np.quantile(arrays["rssi_db"], 0.3))
    plain, data = (from_arrays(arrays | more) for more in ({}, {"sensitivity_db": np.array(floor)}))
    assert len(plain) == len(data) == 3 * listed.sum()
    assert (data.censored == 0).sum() == (one.measured[listed] >= floor).sum()
    levels = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    assert levels.min() > floor - 1e-3


@pytest.mark.parametrize("absent", ["auto", "silent"])
def test_silence_of_a_station_without_a_stated_level_was_lost(absent, recwarn):
    """Of an empty column the note said "below nan dB";
    what `silent` says of such stations was missing.
    """
    arrays, counts = network(0, moments=100).arrays(6), []
    for sensitivity in (None, np.full(30, np.nan)):
        more = {} if sensitivity is None else {"sensitivity_db": sensitivity}
        reading = interpret(Raw(arrays | more, {"absent": absent}), "drive")
        counts.append((reading.data.censored > 0).sum())
        assert not any("nan" in note or "missing" in note for note in reading.notes)
    assert counts[0] == counts[1] and not recwarn.list


def test_silence_was_believed_of_lists_of_the_strongest():
    """`check` said good; the law's exponent became 4.7 for 3.7,
    listed rows were off by 9.6 for 7.0 dB.
    """
    arrays = network(0).arrays(6)
    reading = interpret(Raw(arrays, {"absent": "silent"}), "drive")
    (severe,) = [note for note in reading.notes if isinstance(note, Severe)]
    assert severe.startswith(
        "lists of the 6 strongest of 30 stations with dataset.absent=silent: unlisted "
    )
    assert severe.endswith("; leave absent out")
    # All that is heard: no such lists
    heard = network(0).measured > np.quantile(network(0).measured, 0.6)
    level = np.where(heard, network(0).measured, np.nan)
    wide = {
        "rx_position": network(0).moment,
        "station_position": network(0).place,
        "rssi_db": level,
    }
    assert not [
        n
        for n in interpret(Raw(wide, {"absent": "silent"}), "drive").notes
        if isinstance(n, Severe)
    ]


def test_what_lists_leave_out_was_called_not_heard():
    """The same rows were `unlisted` in one line and `not heard` in the next."""
    arrays = network(0).arrays(6)
    floor = np.array(np.quantile(arrays["rssi_db"], 0.3))
    for more, said in (({}, "not listed"), ({"sensitivity_db": floor}, "not listed or not heard")):
        notes = interpret(Raw(arrays | more), "drive").notes
        assert len([note for note in notes if f"powers were {said}: below" in note]) == 1


def test_stations_that_short_lists_lack_were_taken_as_weak_though_they_were_off():
    """Four strongest of a measured city with outages: listed rows 8.3 dB,
    without these links 6.7 dB.
    """
    one = network(5)
    level = one.measured.copy()
    level[100::4, 3:] = np.nan  # all but one site
    strong = np.argsort(np.argsort(-np.nan_to_num(level, nan=-999), 1), 1) < 4
    moment, cell = np.nonzero(strong & np.isfinite(level))
    arrays = one.arrays(6) | {
        "rx_position": one.moment[moment],
        "station": cell,
        "rssi_db": level[moment, cell],
    }
    reading = interpret(Raw(arrays, {}), "drive")
    assert any(
        "shorter than 4: unknown, strong ones are lost there" in note for note in reading.notes
    )
    short = {tuple(at) for at in one.moment[100::4].round(3)}
    data = reading.data
    silent = (data.moving + data.site.origin)[data.censored > 0].round(3)
    assert len(silent) and not short & {tuple(at) for at in silent}


def four_everywhere() -> dict[str, np.ndarray]:
    """Levels of four stations at 150 places each, link by link,
    the stronger ones of a place first.
    """
    rng = np.random.default_rng(3)
    place, post = rng.uniform(0, 300, (150, 2)), rng.uniform(0, 300, (4, 2))
    far = np.linalg.norm(place[:, None] - post, axis=2)
    level = -30 - 30 * np.log10(far) + rng.normal(0, 4, far.shape)
    moment, who = np.repeat(np.arange(150), 4), np.argsort(-level, axis=1).ravel()
    return {
        "rx_position": np.c_[place[moment], np.full(600, 1.5)],
        "station": who,
        "station_position": np.c_[post, np.full(4, 20.0)],
        "rssi_db": level[moment, who].round(2),
    }


def test_packets_logged_twice_with_another_last_digit_were_lists_of_the_two_strongest():
    """784 rows that never were lay below: answers were 3 to 11 dB too low."""
    once = four_everywhere()
    twice = {
        name: one if name == "station_position" else np.repeat(one, 2, 0)
        for name, one in once.items()
    }
    twice["rssi_db"] = twice["rssi_db"] + 0.01 * (np.arange(1200) % 2)
    reading = interpret(Raw(twice), "drive")
    assert not [note for note in reading.notes if "strongest" in note]
    assert reading.data.censored is None or not reading.data.censored.any()


def test_a_station_of_one_place_made_lists_of_the_strongest_of_all_others():
    arrays = four_everywhere()
    arrays["rx_position"] = arrays["rx_position"].copy()
    arrays["rx_position"][arrays["station"] == 2] = [100.0, 100.0, 1.5]
    reading = interpret(Raw(arrays), "drive")
    assert not [note for note in reading.notes if "strongest" in note]


def serving(one, **more):
    """The strongest cell alone at each moment of a drive."""
    best = one.measured.argmax(1)
    moment = np.arange(len(best))
    arrays = {
        "rx_position": one.moment,
        "station": best,
        "station_position": one.place,
        "rssi_db": one.measured[moment, best],
    }
    return arrays | more


@pytest.mark.parametrize("stands", [False, True])
def test_a_log_of_the_serving_cell_was_learned_as_if_the_others_were_unknown(stands):
    """`absent=silent` was advised for it; against the truth of all cells 10.8 dB,
    of lists of two 3.8.
    """
    one, rng = network(2), np.random.default_rng(0)
    arrays = serving(one)
    rows = np.arange(len(one.moment))
    if stands:  # at some moments the phone stands still, and now and then another cell serves
        rows = np.sort(np.r_[rows, np.repeat(rows[::50], 8)])
        arrays = {
            name: one if name == "station_position" else one[rows] for name, one in arrays.items()
        }
        again = np.flatnonzero(np.r_[False, rows[1:] == rows[:-1]])[::4]
        arrays["station"][again] = rng.integers(0, len(one.place), len(again))
    reading = interpret(Raw(arrays), "drive")
    data = reading.data
    assert any(
        note.startswith("lists of the strongest alone of 30 stations: ") for note in reading.notes
    )
    silent = data.censored > 0
    assert (~silent).sum() >= len(one.moment) and silent.sum() == 2 * (~silent).sum()
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    place = {tuple(at): i for i, at in enumerate(one.moment.round(3))}
    moment = [place[tuple(at)] for at in (data.moving + data.site.origin).round(3)]
    wrong = one.measured[moment, data.station][silent] > level[silent] + 1e-3
    assert wrong.mean() < 0.02
    reading = interpret(Raw(arrays, {"absent": "silent"}), "drive")
    assert any(isinstance(note, Severe) and "leave absent out" in note for note in reading.notes)
