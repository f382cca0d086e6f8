"""Where the seconds of a fit went."""

from gsparc.training.cost import Cost


def test_the_line_names_stages_and_what_had_no_weight():
    cost = Cost({"waves": 3.0, "sources": 6.0, "weighing": 0.01}, {"waves": 3.0})
    said = cost.describe()
    assert said == (
        "waves 3.0 s (3.0 s unused), sources 6.0 s; 33% of 9.0 s spent on what is not used"
    )
    assert Cost({"steps": 1.0}).describe() == "steps 1.0 s; 1.0 s in all"
