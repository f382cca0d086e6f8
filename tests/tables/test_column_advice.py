"""What a column says of levels is found in them: transmitters, devices, numbers;
nothing of chance.
"""

import shlex
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from level_fields import ROWS, truths

from gsparc.datasets.own import read_any
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


@pytest.mark.slow
@pytest.mark.parametrize("head", ["node", "phone", "power"])
def test_the_advice_of_a_message_works_as_written(tmp_path, head):
    """As a shell takes it, in `check`: the message is gone,
    and nothing else is said of the column.
    """
    place, level, columns = truths(1, head)
    columns["tx_power"] = columns.get("power")
    head = head.replace("power", "tx_power")
    path = tmp_path / "log.csv"
    table = {"x": place[:, 0], "y": place[:, 1], "rssi_dbm": level, head: columns[head]}
    pd.DataFrame(table).to_csv(path, index=False)
    said = [
        note for note in read_any(path).notes if f"column '{head}' is not used, but with it" in note
    ]
    assert len(said) == 1, said
    words = shlex.split(said[0].partition("? ")[2])[:1]
    assert words[0].startswith("dataset.columns.")
    run = [sys.executable, "-m", "gsparc", "check", str(path), *words, "--no-draw"]
    found = subprocess.run(run, capture_output=True, text=True, check=False)
    assert found.returncode == 0 and "is not used, but with it" not in found.stdout, found
