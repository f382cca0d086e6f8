"""Kinds of change: what later rows say of other places, by systems of few rows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms_later import draw, later_rows

from gsparc.processes import changes
from gsparc.processes.changes import KINDS, Belief, correct, learn_changes, main_effect
from gsparc.processes.factor import Factor
from gsparc.processes.later_rows import LaterRows

EXTENT = 28.0


def asked(belief, rows, places, level=-60.0):
    at = torch.from_numpy(places)
    flat = torch.full((len(at),), level).double()
    return correct(belief, 0, rows, at, flat, 0.5 + 0 * flat)


def test_without_change_the_map_stays():
    rows = later_rows(40, 0)
    belief = learn_changes({0: rows}, EXTENT)
    assert KINDS[int(belief.of(0)[0].argmax())].name == "none"
    assert (asked(belief, rows, draw(50, 9)).mean + 60).abs().max() < 0.7


def test_an_offset_reaches_everywhere_and_a_local_change_does_not():
    far = np.array([[19.0, 19.0, 1.5]])
    offset, local = later_rows(40, 1, offset=-10.0), later_rows(80, 2, change=-12.0)
    assert asked(learn_changes({0: offset}, EXTENT), offset, far).mean[0] == pytest.approx(
        -70, abs=1
    )
    belief = learn_changes({0: local}, EXTENT)
    assert belief.of(0)[0][[k.name == "local" for k in KINDS]].sum() > 0.9
    assert asked(belief, local, far).mean[0] == pytest.approx(-60, abs=1.5)
    assert asked(belief, local, np.array([[5.0, 5.0, 1.5]])).mean[0] < -66


def test_an_offset_of_all_stations_is_told_of_those_without_rows():
    rows = {station: later_rows(10, station, offset=-4.0) for station in range(12)}
    belief = learn_changes(rows, EXTENT)
    assert belief.common == pytest.approx(-4, abs=0.8)
    at = torch.zeros(1, 3).double()
    none = correct(belief, 99, LaterRows.empty(), at, at[:, 0] - 60, at[:, 0] + 1)
    assert none.mean[0] == -60 + belief.common


def test_a_station_whose_stated_noise_is_too_small_is_not_taken_for_a_local_change():
    rng, quiet = np.random.default_rng(3), {n: later_rows(20, n) for n in range(9)}
    rows = later_rows(20, 9)
    loud = replace(
        rows,
        missed=torch.from_numpy(rng.normal(0, 4, 20)),
        noise=0 * rows.noise,
        doubt=0 * rows.doubt,
    )
    belief = learn_changes({**quiet, 9: loud}, EXTENT)
    weight, added = belief.of(9)
    assert added > 8 and weight[:3].sum() > 0.9
    assert max(belief.of(n)[1] for n in quiet) < 3


def test_a_common_offset_is_not_believed_where_places_differ():
    """A phone that was held otherwise at each of five places misses all stations
    of a place alike.
    """
    places, at = draw(5, 1), np.array([4.0, -4.0, -5.0, -3.0, -4.5])
    rows = [replace(later_rows(5, n), places=torch.from_numpy(places)) for n in range(20)]
    turned = [replace(one, missed=one.missed + torch.from_numpy(at)) for one in rows]
    alike = [replace(one, missed=one.missed - 3) for one in rows]
    assert abs(learn_changes(dict(enumerate(turned)), EXTENT).common) < 0.6 * 2.5
    assert learn_changes(dict(enumerate(alike)), EXTENT).common == pytest.approx(-3, abs=0.8)


def test_a_lone_station_that_seems_moved_voided_a_quarter_of_the_map():
    """Rows about a cabinet that was moved look like those of a station that was."""
    rows = later_rows(10, 1, offset=-15.0)
    rows = replace(rows, places=rows.places / 10)  # in 2 m of a room of 20 m
    moved = torch.tensor([[float(kind.name == "moved") for kind in KINDS]]).double()
    belief = Belief(EXTENT, weight=moved, names=(0,))
    near, far = asked(belief, rows, np.array([[1.0, 1.0, 0.15], [7.0, 7.0, 0.15]])).mean
    assert near < -72 and far > -62


def test_no_system_is_larger_than_the_nearest_rows(monkeypatch):
    sizes, rows = [], later_rows(3000, 3, offset=-5.0)
    make = Factor.from_gram
    spied = lambda gram, *rest: sizes.append(gram.shape[-1]) or make(gram, *rest)  # noqa: E731
    monkeypatch.setattr(changes.Factor, "from_gram", spied)
    belief = learn_changes({0: rows}, EXTENT)
    asked(belief, rows, draw(5, 9))
    assert sizes and max(sizes) <= changes.NEAR


def test_a_walk_elsewhere_is_no_reason_to_forget_a_change():
    rows, walk = later_rows(60, 2, change=-12.0), later_rows(80, 30)
    far = replace(walk, places=walk.places / 2 + torch.tensor([10.0, 10.0, 0.75]))
    there = np.array([[5.0, 5.0, 1.5], [4.0, 6.0, 1.5]])
    before, after = (
        asked(learn_changes({0: one}, EXTENT), one, there).mean for one in (rows, rows.join(far))
    )
    assert (before < -65).all() and after == pytest.approx(before, abs=1)
    assert len(rows.join(far).spread(EXTENT, 40)) == 40


def test_rows_that_equal_their_map_had_a_change_that_is_no_number():
    rows = later_rows(20, 3)
    kind, change, share = main_effect(replace(rows, missed=0 * rows.missed), EXTENT)
    assert kind != "none" and change == 0 and share.sum() == pytest.approx(1)
