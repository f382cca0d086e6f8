"""Alarms: none while nothing changes, then soon, dated, placed and named."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms_later import CABINET, later_rows

from gsparc.data.schema import Site, Stations
from gsparc.prediction.drift import Watch
from gsparc.processes.changes import LaterRows

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
    return Watch.from_site(site(of)).look(stations, 0, EXTENT)[0].alarms


def test_no_alarm_without_change():
    assert not sum(len(alarms_of({0: later_rows(1000, seed)})) for seed in range(4))


def test_an_offset_is_noticed_dated_and_named():
    (alarm,) = alarms_of({0: sequence(0, offset=-7.0)})
    assert alarm.kind == "offset" and alarm.change_db == pytest.approx(-7, abs=1.5)
    assert BEGIN <= alarm.at < BEGIN + 12 and abs(alarm.since - BEGIN) < 5


def test_a_local_change_is_placed():
    alarm = alarms_of({0: sequence(1, change=-12.0)})[0]
    assert alarm.kind == "local" and BEGIN <= alarm.at < BEGIN + 80
    assert np.linalg.norm(np.array(alarm.place) - CABINET) < 3 and alarm.change_db < -6


def test_a_change_is_noticed_once_and_its_end_is_named():
    parts = later_rows(100, 7), later_rows(400, 8, change=-12.0), later_rows(150, 9)
    every = parts[0].join(parts[1]).join(parts[2])
    rows = LaterRows(torch.arange(len(every)), *list(vars(every).values())[1:])
    first, last = alarms_of({0: rows})
    assert first.kind == "local" and 100 <= first.at < 180
    assert last.kind == "returned" and 500 <= last.at < 560 and abs(last.change_db) < 1


def test_files_of_before_returns_were_told_are_followed_on():
    watch = Watch.from_site(site()).look({0: later_rows(5, 3)}, 0, EXTENT)[0]
    older = {name: getattr(watch, name)[:-1] for name in ("detector", "total", "since")}
    rows = later_rows(9, 3)
    now, then = (one.look({0: rows}, 5, EXTENT)[0] for one in (watch, replace(watch, **older)))
    assert (now.detector == then.detector).all()


def test_a_station_that_is_heard_no_more_is_gone():
    rows = sequence(2, offset=-20.0)
    gone = LaterRows(*list(vars(rows).values())[:-1], rows.number >= BEGIN)
    assert alarms_of({0: gone})[0].kind == "gone"


def test_what_all_stations_miss_is_a_device():
    every = {}
    for station in range(6):
        rows = sequence(station + 10, 30, offset=-5.0)
        every[station] = LaterRows(rows.number * 6 + station, *list(vars(rows).values())[1:])
    places = every[0].places  # all are heard at one place
    parts = [list(vars(rows).values()) for rows in every.values()]
    rows = {n: LaterRows(*part[:2], places, *part[3:]) for n, part in enumerate(parts)}
    alarms = alarms_of(rows, [*range(6)])
    assert alarms[0].kind == "device" and alarms[0].station == -1


def test_rows_one_at_a_time_are_rows_at_once():
    rows = later_rows(60, 3, offset=-7.0)
    whole, surprise = Watch.from_site(site()).look({0: rows}, 0, EXTENT)
    one, parts = Watch.from_site(site()), []
    for turn in range(60):
        one, part = one.look({0: rows[: turn + 1]}, turn, EXTENT)
        parts.append(part)
    assert [a.at for a in one.alarms] == [a.at for a in whole.alarms]
    assert np.allclose(np.concatenate(parts)[: whole.alarms[0].at], surprise[: whole.alarms[0].at])
