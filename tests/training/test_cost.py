"""Where the seconds of a fit went."""

import pytest

from gsparc.training.cost import NO_COST, Cost


def test_the_line_names_stages_what_had_no_weight_and_the_gain():
    cost = Cost({"waves": 3.0, "sources": 6.0, "weighing": 0.01}, {"waves": 3.0}, 1.25)
    said = cost.described("wall")
    assert said.startswith("waves 3.0 s (3.0 without weight), sources 6.0 s; 33% of 9.0 s without weight; ")
    assert "took 20% off the held-out error" in said, said
    assert "weighing" not in said, "too short to be named"
    assert cost.described(None).endswith("no clock ended it: steps and searches are counted")


def test_a_gain_that_is_not_known_is_not_promised():
    assert Cost({"steps": 1.0}).described("wall").endswith("what more would bring is not known")


def test_stations_add_up():
    one, other = Cost({"powers": 2.0, "steps": 1.0}, {"steps": 1.0}), Cost({"powers": 3.0}, {}, 1.1)
    both = one + other
    assert (dict(both.stages), dict(both.unused)) == ({"powers": 5.0, "steps": 1.0}, {"steps": 1.0})
    assert both.gain is None
    assert both.unused_s == pytest.approx(1.0)
    assert NO_COST + other == other
