"""Alarms: none while nothing changes, then soon, dated, placed and named."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms_later import CABINET, later_rows

from gsparc.data.schema import Site, Stations
from gsparc.prediction.drift import Watch
from gsparc.processes.later_rows import LaterRows

BEGIN, EXTENT = 150, 28.0


def site(stations=None):
    box = np.array([[0.0, 0, 1.5], [20, 20, 1.5]])
    site = Site("hall", "rssi", "tx", None, None, None, None, moving_box=box)
    names = tuple(map(str, range(len(stations or ()))))
    return replace(site, stations=Stations(np.zeros((len(names), 3)), names) if names else None)


def sequence(seed, count=150, **changed):
    """Rows of which those from `BEGIN` on are of a changed world."""
    before, after = later_rows(BEGIN, seed), later_rows(count, seed + 500, **changed)
    both = before.join(after)
    return LaterRows(torch.arange(len(both)), *list(vars(both).values())[1:])


def alarms_of(stations, of=None):
    return Watch.from_site(site(of)).look(stations, 0, EXTENT).alarms


def test_no_alarm_without_change():
    assert not sum(len(alarms_of({0: later_rows(1000, seed)})) for seed in range(4))


def test_an_offset_is_noticed_dated_and_named():
    (alarm,) = alarms_of({0: sequence(0, offset=-7.0)})
    assert alarm.kind == "offset" and alarm.change_db == pytest.approx(-7, abs=1.5)
    assert BEGIN <= alarm.at < BEGIN + 12 and abs(alarm.since - BEGIN) < 6


def test_a_local_change_is_placed():
    alarm = alarms_of({0: sequence(1, change=-12.0)})[0]
    assert alarm.kind == "local" and BEGIN <= alarm.at < BEGIN + 80
    assert np.linalg.norm(np.array(alarm.place) - CABINET) < 3 and alarm.change_db < -6


def test_a_change_is_noticed_once_and_its_end_is_named():
    watch, rows = Watch.from_site(site()), LaterRows.empty()
    for turn, change in enumerate((0.0, 0.0, *[-12.0] * 6, *[0.0] * 4)):
        new = later_rows(50, 7 + turn, change=change)
        new = LaterRows(new.number + 50 * turn, new.batch + turn, *list(vars(new).values())[2:])
        watch = watch.look({0: rows.join(new)}, 50 * turn, EXTENT)
        rows = watch.of_now(0, rows.join(new))
    first, last = watch.alarms
    assert first.kind == "local" and 100 <= first.at < 180
    assert last.kind == "returned" and 400 <= last.at < 600 and abs(last.change_db) < 1.5


def test_a_station_that_is_heard_no_more_is_gone():
    rows = sequence(2, offset=-20.0)
    gone = LaterRows(*list(vars(rows).values())[:-1], rows.number >= BEGIN)
    assert alarms_of({0: gone})[0].kind == "gone"


def test_what_all_stations_miss_is_a_device():
    watch, rows = Watch.from_site(site([*range(6)])), {}
    for offset in (0.0, -5.0):
        first = 180 * (offset < 0)
        for station in range(6):
            new = list(vars(later_rows(30, station + 10, offset=offset)).values())
            later = LaterRows(new[0] * 6 + station + first, new[1] + (offset < 0), *new[2:])
            rows[station] = rows.get(station, LaterRows.empty()).join(later)
        watch = watch.look(rows, first, EXTENT)
    (alarm,) = watch.alarms
    assert alarm.kind == "device" and alarm.station == -1 and alarm.since == 180
    assert alarm.change_db == pytest.approx(-5, abs=1)


def test_an_offset_of_a_device_under_its_own_error_is_no_alarm():
    """Of four cells and an unchanged drive four alarms of .1 to 1.9 dB were called a device."""
    rows = {n: later_rows(40, n, offset=(-1.9, 1.5, 0.1, 1.0, 0.8, 0.3)[n]) for n in range(6)}
    assert not alarms_of(rows, [*range(6)])


def test_rows_one_at_a_time_are_rows_at_once():
    rows = later_rows(60, 3, offset=-7.0)
    (whole,) = alarms_of({0: rows})
    watch = Watch.from_site(site())
    for turn in range(60):
        watch = watch.look({0: rows[: turn + 1]}, turn, EXTENT)
    (single,) = watch.alarms
    assert single.kind == whole.kind and abs(single.at - whole.at) < 8
    assert single.change_db == pytest.approx(whole.change_db, abs=0.1)
