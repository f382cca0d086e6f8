"""Who is beaten, in words and drawn."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsparc.evaluation.experiment.tradeoff import find_better
from gsparc.prediction.pareto import Point, describe_point, pareto_front

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


def other(psnr_db: float, ms: float) -> Point:
    return Point("a baseline", {}, 1, {"psnr_db": psnr_db}, np.nan, np.full(3, ms))


def test_a_point_that_another_method_beats_is_said():
    point = Point("p", {}, 1, {"psnr_db": 20.0}, 0.0, np.full(3, 1.0))
    others = {"nearest": other(26.0, 0.5), "gp": other(29.0, 2.0), "mean": other(15.0, 0.1)}
    assert find_better(point, others, "psnr_db") == "nearest"
    assert find_better(point, {"gp": others["gp"], "mean": others["mean"]}, "psnr_db") is None
