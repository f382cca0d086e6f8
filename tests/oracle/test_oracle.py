"""Stored fits of fixed problems load and answer, and fresh fits choose, as they did.

What a machine stored is held to what machines differ by; `make oracle BASE=COMMIT` compares two
trees on one machine, a hundred times as strictly.
"""

from pathlib import Path

import pytest
from fits import answers, fitted, moved, read, stem
from problems import PROBLEMS, parted
from two_trees import changed

STORED = Path(__file__).parent / "stored"
MACHINES = 3e-3  # of the targets' deviation
ANSWERS, FIGURES = read(STORED)
FRESH = [
    pytest.param(name, marks=pytest.mark.slow if one.slow else ()) for name, one in PROBLEMS.items()
]


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_stored_fit_answers_as_it_did(name):
    asked = parted(PROBLEMS[name].arrays())[1]
    told = answers(STORED / f"{stem(name)}.ckpt", asked)
    assert not moved(ANSWERS[name], told, asked, MACHINES, MACHINES)


@pytest.mark.parametrize("name", FRESH)
def test_a_fresh_fit_chooses_as_it_did(name, tmp_path):
    now, before = fitted(name, tmp_path), FIGURES[name]
    for choice in ("choices", "class", "effects", "init"):
        assert now[f"model/{choice}"] == before[f"model/{choice}"]
    # Settings of `test_processors.py` move it by 6e-4
    assert now["error"] <= 1.01 * before["error"]


def test_two_trees_are_told_apart():
    old = {"error": 0.5, "learned": "length 2.000 m", "class": "Powers"}
    assert not changed(old, {"error": 0.50001, "learned": "length 2.0001 m", "class": "Powers"})
    assert changed(old, {"error": 0.51, "learned": "length 2.1 m", "class": None}) == [
        "class: Powers -> None",
        "error: 0.5 -> 0.51",
        "learned: length 2.000 m -> length 2.1 m",
    ]
