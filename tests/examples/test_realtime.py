"""The loop of 1,000 places a second counts what it misses."""

import importlib
import time
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "realtime"


@pytest.fixture
def loop(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("loop")


def test_each_tick_is_answered_or_missed(loop):
    places = []

    def slow(place):
        places.append(place)
        if len(places) == 3:
            time.sleep(0.055)

    run = loop.play(slow, np.array([1.0, 2, 3]), 0.2, 0.01)
    assert len(run.latency_s) + run.missed == 20 and 5 <= run.missed < 18
    assert run.latency_s[2] >= 0.055 and len(places) == len(run.latency_s)
    np.testing.assert_allclose(np.linalg.norm(np.array(places) - [1, 2, 3], axis=1), loop.RADIUS)


def test_without_a_field_it_says_how(loop, capsys):
    assert loop.main([]) == 2 and "field.gsparc" in capsys.readouterr().err
