"""Examples of docstrings answer what they say."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

import gsparc

RNG = np.random.default_rng(0)
PLACES = np.c_[RNG.uniform(0, 9, (60, 2)), np.full(60, 1.5)]
ENDS = np.array([[4.0, 4.0, 2.6], [9.0, 9.0, 2.6]])
POWERS = -30 - 25 * np.log10(np.linalg.norm(PLACES[:, None] - ENDS, axis=2)) + RNG.normal(size=(60, 2))
WHERE = dict.fromkeys(gsparc.__all__, "gsparc")
if Path(gsparc.__file__).with_name("apps").is_dir():  # the core may stand alone
    WHERE |= {"map_of": "gsparc.apps.maps", "plan_next": "gsparc.apps.maps", "locate": "gsparc.apps.locate"}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder with the files that the examples load."""
    folder = tmp_path_factory.mktemp("examples")
    gsparc.fit(rx=PLACES, tx=ENDS[0], rssi=POWERS[:, 0], model="gp", save=folder / "model.ckpt")
    degrees = {"latitude": 40.765 + PLACES[:, 1] * 1e-5, "longitude": -111.835 + PLACES[:, 0] * 1e-5}
    ends = {"station_latitude": 40.765 + ENDS[:, 1] * 1e-5, "station_longitude": -111.835 + ENDS[:, 0] * 1e-5}
    names = {"station_name": np.array(["roof-2", "roof-3"])}
    gsparc.fit(**degrees, **ends, **names, rssi=POWERS, model="gp", save=folder / "city.ckpt")
    return folder


def examples(of: object, name: str) -> list[doctest.DocTest]:
    """Those of an object and of what is defined in it."""
    found = doctest.DocTestFinder(exclude_empty=True).find(of, name, globs={})
    return [test for test in found if test.examples]


@pytest.mark.parametrize("name", WHERE)
def test_examples_of_docstrings_run(name, checkpoints, monkeypatch):
    monkeypatch.chdir(checkpoints)
    of = getattr(import_module(WHERE[name]), name)
    known = {"gsparc": gsparc, "torch": torch, "predictor": gsparc.load("model.ckpt"), "places": PLACES}
    known |= {one: getattr(gsparc, one) for one in gsparc.__all__}
    known |= {name: of, "powers_dbm": POWERS[:, 0]}
    tests = examples(of, name)
    assert tests, f"{name} has no example"
    report: list[str] = []
    for test in tests:
        test.globs = dict(known)
        assert not doctest.DocTestRunner().run(test, out=report.append).failed, "".join(report)
