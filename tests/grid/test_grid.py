"""The grid of kinds: `model=gsparc` serves every kind of data,
and never loses to a plain method beside it.

`make grid` runs the whole covering set with defaults; here few seconds are given to each, so that a
loss counts when it is a gross one, after five fresh seeds.
"""

import numpy as np
import pytest
from campaigns import compose
from judging import repeated, run
from product import PARTS
from worlds import CHOICES, World, arrays, covering, every, possible_pairs

from gsparc.runs.baselines import fit_baseline
from gsparc.runs.inputs import read_inputs

FEW = covering(every((30,)), 1)[:14]  # seven of eight pairs; `make grid` has all
QUICK = (0, 2, 3, 4, 7, 8)  # of them, at every change: those of under three seconds
SOME = covering(every((300,)), 1)[:7]  # the first meet most pairs
GROSS = 1.5  # times the allowed error, in decibels as much more


def assert_served(world: World, folder, effort: float, parts=PARTS) -> None:
    """Train, and fail where the default is behind on fresh seeds as well,
    or a part does not answer.
    """
    more = (f"effort={effort}", "threads=1")
    found, objects = run(world, 0, folder, more)
    assert not found.refused, found.refused
    if found.grossly_behind(GROSS):
        again = repeated(world, folder, more)
        assert not again.grossly_behind(GROSS), again.line()
    for part in parts:
        part(world, folder, objects)


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(i, id=world.name, marks=[pytest.mark.slow] * (i not in QUICK))
        for i, world in enumerate(FEW)
    ],
)
def test_every_kind_of_thirty_rows(number, tmp_path):
    # Each part of the product meets several kinds; all meet all in `make grid`.
    parts = [part for place, part in enumerate(PARTS) if place < 3 or (number + place) % 5 == 0]
    assert_served(FEW[number], tmp_path, 0.1, parts)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "world",
    [
        pytest.param(one, id=one.name, marks=pytest.mark.rare if i > 1 else ())
        for i, one in enumerate(SOME)
    ],
)
def test_every_kind_of_three_hundred_rows(world, tmp_path):
    assert_served(world, tmp_path, 0.5)


@pytest.mark.slow
def test_a_process_of_one_length_predicted_the_mean_in_a_gap(tmp_path):
    world = World("moving_array", 1, 4, "rx", "metres", "none", "blocks", 300)
    np.savez(file := tmp_path / "own.npz", **arrays(world, 33))
    begun = read_inputs(
        compose("dataset=own", f"dataset.file='{file}'", "model=gp", "split=blocks", "logger=none")
    )
    data, split = begun.module.measurements, begun.split
    figures = [
        fit_baseline(name, data, split).scores.figures()["psnr_db"] for name in ("gp", "idw")
    ]
    assert figures[0] > figures[1] + 0.1


def test_the_covering_set_has_every_pair():
    worlds = every()
    missing = possible_pairs(worlds) - possible_pairs(covering(worlds))
    assert not missing and len(covering(worlds)) < 40
    assert {kind for world in FEW for kind in [world.kind]} == set(CHOICES["kind"])
