"""Who is beaten, in words and drawn."""

import pandas as pd
from hypothesis import given
from hypothesis import strategies as st

from gsparc.prediction.operating_point import describe_point, pareto_front
from gsparc.runs.experiment.tradeoff import find_better

PAIRS = st.lists(st.tuples(st.floats(0.01, 100), st.floats(-50, 50)), min_size=1, max_size=30)


@given(PAIRS)
def test_nobody_on_the_front_is_beaten_and_everybody_else_is(pairs):
    latency, score = zip(*pairs, strict=True)
    kept = pareto_front(latency, score)
    for i in range(len(pairs)):
        beaten = any(
            latency[j] <= latency[i]
            and score[j] >= score[i]
            and (latency[j], -score[j]) < (latency[i], -score[i])
            for j in range(len(pairs))
        )
        same = any((latency[j], score[j]) == (latency[i], score[i]) for j in kept)
        assert (i in kept) == (not beaten and (i in kept)) and (beaten or same)
    assert [latency[i] for i in kept] == sorted(latency[i] for i in kept)


def test_settings_are_said_in_words():
    assert describe_point({}) == "as trained"
    assert (
        describe_point({"keep": 0.25, "stride": 3, "confidence": False})
        == "25% kept, 1 of 3 x 3 pixels, no confidence"
    )


def test_a_point_that_another_method_beats_is_said():
    others = pd.DataFrame(
        {
            "label": ["nearest", "gp", "mean"],
            "render_ms_p50": [0.5, 2.0, 0.1],
            "score": [26.0, 29, 15],
        }
    )
    point = {"render_ms_p50": 1.0, "score": 20.0}
    assert find_better(point, others) == "nearest" and find_better(point, others[1:]) is None
