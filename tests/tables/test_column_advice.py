"""What a column says of levels is found in them: transmitters, devices, numbers;
nothing of chance.
"""

import numpy as np
import pytest
from level_fields import ROWS, truths

from gsparc.tables.advice import LevelsAtPlaces, find_effects


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "head, kind",
    [("node", "transmitter"), ("hop", "transmitter"), ("phone", "device"), ("power", "number")],
)
def test_what_a_column_does_is_named_and_nothing_else(seed, head, kind):
    place, level, columns = truths(seed, head)
    links = LevelsAtPlaces(place, np.zeros(ROWS, int), level)
    texts = {name: np.array([f"{value:g}" for value in values]) for name, values in columns.items()}
    assert [(one.head, one.kind) for one in find_effects(links, np.arange(ROWS), texts)] == [
        (head, kind)
    ]


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 6))]
)
def test_columns_of_chance_and_qualities_say_nothing(seed):
    place, level, columns = truths(seed, "")
    links = LevelsAtPlaces(place, np.zeros(ROWS, int), level)
    texts = {name: np.array([f"{value:g}" for value in values]) for name, values in columns.items()}
    assert not find_effects(links, np.arange(ROWS), texts)
