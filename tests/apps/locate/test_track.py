"""The filter over a track: steps, jumps, what it is against plain sums, and its speed."""

import numpy as np

from gsparc.apps.locate.cells import Cells, cover
from gsparc.apps.locate.likelihood import Trust
from gsparc.apps.locate.posterior import Posterior
from gsparc.apps.locate.track import ANYWHERE, as_looked, smoothed, speed


def hall() -> Cells:
    return cover(np.array([[0.0, 0, 1], [20, 10, 1]]), 200, False)


def heard(cells: Cells, place: np.ndarray, spread: float = 2.0) -> Posterior:
    density = -0.5 * ((cells.centre - place) ** 2).sum(1) / spread**2
    return Posterior(cells, density - np.log((np.exp(density) * cells.size).sum()))


def mean(known: Posterior) -> np.ndarray:
    return known.mass @ known.cells.centre


def test_walk_is_placed_better_than_its_snapshots():
    rng, cells, seconds = np.random.default_rng(0), hall(), np.arange(30.0)
    true = np.c_[4 + 0.4 * seconds, np.full(30, 5.0), np.ones(30)]
    alone = [heard(cells, place + rng.normal(0, 2, 3) * [1, 1, 0]) for place in true]
    shuffled = rng.permutation(30)
    found = smoothed([alone[i] for i in shuffled], seconds[shuffled], 0.5)  # by time, in whatever order
    errors = [
        np.linalg.norm([mean(one) for one in some] - at, axis=1).mean()
        for some, at in ((alone, true), (found, true[shuffled]))
    ]
    assert errors[1] < 0.6 * errors[0]
    assert all(np.isclose(one.mass.sum(), 1) for one in found)


def test_filter_is_the_sum_over_all_walks():
    """Three snapshots over few cells: every sequence of cells, weighed by hand."""
    cells = cover(np.array([[0.0, 0, 1], [6, 3, 1]]), 18, False)
    alone = [heard(cells, np.array(at), 1.5) for at in ([1.0, 1, 1], [3, 2, 1], [5, 1, 1])]
    seconds, pace = np.array([0.0, 2, 3]), 1.2
    order = [np.argsort(-one.log_density, kind="stable") for one in alone]
    apart = ((cells.centre[:, None] - cells.centre) ** 2).sum(2)

    def step(took: float) -> np.ndarray:
        spread = max(pace * took / np.sqrt(2), cells.edge.max() / 2)
        normal = np.exp(-0.5 * apart / spread**2) / (2 * np.pi * spread**2)
        return (1 - ANYWHERE) * normal + ANYWHERE / cells.size.sum()

    a, b, c = (one.mass for one in alone)
    every = a[:, None, None] * step(2)[:, :, None] * b[None, :, None] * step(1)[None] * c
    wanted = [every.sum((1, 2)), every.sum((0, 2)), every.sum((0, 1))]
    for one, some, by_hand in zip(smoothed(alone, seconds, pace), order, wanted, strict=True):
        np.testing.assert_allclose(one.mass, (by_hand / by_hand.sum())[some], rtol=1e-9)


def test_jump_is_tracked():
    cells = hall()
    there = [np.array([2.0, 5, 1])] * 5 + [np.array([18.0, 5, 1])] * 5
    found = smoothed([heard(cells, place, 1.0) for place in there], np.arange(10.0), 0.2)
    assert max(np.linalg.norm(mean(one) - place) for one, place in zip(found, there, strict=True)) < 1.0


def test_speed_is_of_steps_within_walks():
    places = np.array([[0.0, 0, 0], [2, 0, 0], [4, 0, 0], [100, 0, 0], [103, 0, 0]])
    seconds, walk = np.array([0.0, 1, 2, 0, 1]), np.array([0, 0, 0, 1, 1])
    assert speed(places, seconds, walk) == 2.0
    assert speed(places[:1], seconds[:1], walk[:1]) == 0.0


def test_only_the_temperature_flattens_a_posterior():
    known = heard(hall(), np.array([5.0, 5, 1]))
    same, flat = (as_looked(known).by(Trust(3.0, t, 2.0)) for t in (1.0, 0.25))
    np.testing.assert_allclose(same.log_density, known.log_density, atol=1e-9)
    assert flat.log_density.max() < known.log_density.max()
