"""What a column says of levels is found in them: transmitters, devices, numbers; nothing of chance."""

import shlex
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import cdist

from gsparc.data.checks.column_effects import LevelsAtPlaces, find_effects
from gsparc.data.tables.read import parse_table

ROWS = 300


def fields(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2) [m], and levels (n, count) [dB] of transmitters there."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, [600, 400], (ROWS, 2))
    root = np.linalg.cholesky(36 * np.exp(-cdist(place, place) / 80) + 1e-6 * np.eye(ROWS))
    away = [np.hypot(15, cdist(place, rng.uniform(0, [600, 400], (1, 2)))[:, 0]) for _ in range(count)]
    return place, np.stack([-30 - 32 * np.log10(d) + root @ rng.normal(size=ROWS) for d in away], 1)


def truths(seed: int, kind: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Places, levels, and columns: what `kind` names, and some that say nothing, or follow the level."""
    rng = np.random.default_rng(seed + 100)
    place, level = fields(seed, 4 if kind == "node" else 1)
    which = rng.integers(0, 4, ROWS)
    columns = {"node": which, "phone": which % 2, "power": 3 * which + 2, "hop": which > 2}
    column = columns.get(kind, which)
    level = level[np.arange(ROWS), which] if kind == "node" else level[:, 0]
    level = level + {"phone": 4 * (which % 2), "power": 3 * which + 2}.get(kind, 0)
    level = np.where(which > 2, -70 + rng.normal(0, 2, ROWS), level) if kind == "hop" else level
    level = np.round(level + rng.normal(0, 2, ROWS))
    others = {
        "day": np.repeat(np.arange(10), ROWS // 10), "street": place[:, 0] // 100, 
        "speed": rng.gamma(3, 3, ROWS),
        "bars": np.clip((level + 120) // 12, 0, 4), "asu": level + 140, 
        "snr": level + 115 + rng.normal(0, 1, ROWS),
        "rsrq": np.round(-10 + (level + 90) / 8 + rng.normal(0, 1, ROWS)), 
        "channel": rng.integers(0, 8, ROWS),
    }  # fmt: skip
    return place, level, others | ({kind: column} if kind else {})


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "head, kind", [("node", "transmitter"), ("hop", "transmitter"), ("phone", "device"), ("power", "number")]
)
def test_what_a_column_does_is_named_and_nothing_else(seed, head, kind):
    place, level, columns = truths(seed, head)
    links = LevelsAtPlaces(place, np.zeros(ROWS, int), level)
    texts = {name: np.array([f"{value:g}" for value in values]) for name, values in columns.items()}
    assert [(one.head, one.kind) for one in find_effects(links, np.arange(ROWS), texts)] == [(head, kind)]


@pytest.mark.parametrize("seed", range(6))
def test_columns_of_chance_and_qualities_say_nothing(seed):
    place, level, columns = truths(seed, "")
    links = LevelsAtPlaces(place, np.zeros(ROWS, int), level)
    texts = {name: np.array([f"{value:g}" for value in values]) for name, values in columns.items()}
    assert not find_effects(links, np.arange(ROWS), texts)


@pytest.mark.parametrize("head", ["node", "phone", "power"])
def test_the_advice_of_a_message_works_as_written(tmp_path, head):
    """As a shell takes it, in `check`: the message is gone, and nothing else is said of the column."""
    place, level, columns = truths(1, head)
    columns["tx_power"] = columns.get("power")
    head = head.replace("power", "tx_power")
    path = tmp_path / "log.csv"
    table = {"x": place[:, 0], "y": place[:, 1], "rssi_dbm": level, head: columns[head]}
    pd.DataFrame(table).to_csv(path, index=False)
    said = [note for note in parse_table(path).notes if f"column '{head}' is not used and explains" in note]
    assert len(said) == 1, said
    advice = said[0].partition("? ")[2].partition(" ta" if head == "tx_power" else " te")[0]
    words = shlex.split(advice)
    assert len(words) == 1 and words[0].startswith("dataset.columns.")
    run = [sys.executable, "-m", "gsparc", "check", str(path), *words, "--no-draw"]
    found = subprocess.run(run, capture_output=True, text=True, check=False)
    assert found.returncode == 0 and "is not used and explains" not in found.stdout, found
