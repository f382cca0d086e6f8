"""Stored fits answer as they did, fresh fits choose and miss as they did: `make oracle` stores both anew."""

import pytest
import torch
from problems import PROBLEMS, parted
from stored_fits import STORED, answers, changed, fitted, moved, stem, stored_answers, stored_facts

import gsparc

FRESH = [pytest.param(name, marks=pytest.mark.slow if one.slow else ()) for name, one in PROBLEMS.items()]


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_stored_fit_answers_as_it_did(name):
    _, asked = parted(PROBLEMS[name].arrays())
    before = stored_answers(name)
    assert before
    assert not moved(before, answers(gsparc.load(STORED / f"{stem(name)}.ckpt"), asked), asked)


@pytest.mark.parametrize("name", FRESH)
def test_a_fresh_fit_chooses_as_it_did(name, tmp_path):
    now, before = fitted(name, tmp_path)[1], stored_facts()[name]
    assert now["error"] <= 1.01 * before["error"]
    assert not changed(before, now)


def test_the_oracle_tells_what_moved():
    old = {"error": 0.5, "notes": ["length 2.000 m"], "kept": True}
    assert not changed(old, {"error": 0.50001, "notes": ["length 2.0001 m"], "kept": True})
    new = {"error": 0.51, "notes": ["length 2.1 m"], "kept": False}
    assert changed(old, new) == [
        "error: 0.5 -> 0.51", "kept: True -> False", "notes: length 2.000 m -> length 2.1 m",
    ]  # fmt: skip
