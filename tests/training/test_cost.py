"""Where the seconds of a fit went."""

import pytest

from gsparc.training.cost import NO_COST, Cost


def test_the_line_names_stages_and_what_had_no_weight():
    cost = Cost({"waves": 3.0, "sources": 6.0, "weighing": 0.01}, {"waves": 3.0})
    said = cost.describe()
    assert said == (
        "waves 3.0 s (3.0 s unused), sources 6.0 s; 33% of 9.0 s spent on what is not used"
    )
    assert Cost({"steps": 1.0}).describe() == "steps 1.0 s; 1.0 s in all"


def test_stations_add_up():
    one, other = Cost({"powers": 2.0, "steps": 1.0}, {"steps": 1.0}), Cost({"powers": 3.0}, {})
    both = one + other
    assert (dict(both.stages), dict(both.unused)) == ({"powers": 5.0, "steps": 1.0}, {"steps": 1.0})
    assert both.unused_s == pytest.approx(1.0)
    assert NO_COST + other == other
