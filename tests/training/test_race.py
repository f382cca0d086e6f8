"""Who is surely behind, and who may still catch up."""

import math

import numpy as np
import pytest
import torch

from gsparc.training.race import Behind, Race

ROWS = np.array([7, 2, 9, 4])


def race(looks=None):
    target = torch.ones(4, 2, dtype=torch.complex64)
    mean = target * torch.tensor([0.9, 0.8, 0.9, 0.8])[:, None]
    return Race.of(ROWS, mean, target, lambda *look: None if looks is None else looks.append(look))


def test_only_rows_that_both_left_out_are_compared():
    assert race().error == pytest.approx(0.025)
    with pytest.raises(Behind, match=r"one miss 0.090 .* another 0.040"):
        race().looked("one", np.array([3, 4, 2]), np.array([0.0, 0.09, 0.09]))


def test_a_candidate_ends_where_it_is_surely_behind_and_hardly_gains():
    looks, bad = [], np.array([0.5, 0.6, 0.5, 0.6])
    one = race(looks)
    assert one.looked("first", ROWS, bad, math.inf) == pytest.approx(0.55)  # nothing is known of its gains
    assert one.looked("falling", ROWS, bad, 1.0) == pytest.approx(0.55)
    with pytest.raises(Behind, match=r"stalled miss 0.550 .* another 0.025"):
        one.looked("stalled", ROWS, bad, 0.6)
    assert one.looked("unsure", ROWS, np.array([2.0, 0.0, 0.0, 0.0]), 0.6) == pytest.approx(0.5)
    assert [what for what, _ in looks] == ["first", "falling", "stalled", "unsure"]
