"""Examples of docstrings answer what they say."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
import torch

import gsparc
import gsparc.apps.locate
import gsparc.apps.maps

RNG = np.random.default_rng(0)
PLACES = np.c_[RNG.uniform(0, 9, (60, 2)), np.full(60, 1.5)]
ENDS = np.array([[4.0, 4.0, 2.6], [9.0, 9.0, 2.6]])
POWERS = -30 - 25 * np.log10(np.linalg.norm(PLACES[:, None] - ENDS, axis=2)) + RNG.normal(size=(60, 2))
PUBLIC = {name: getattr(gsparc, name) for name in gsparc.__all__}
APPS = {name: getattr(gsparc.apps.maps, name) for name in ("map_of", "plan_next")}
APPS |= {"locate": gsparc.apps.locate.locate}


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


@pytest.mark.parametrize("name", PUBLIC | APPS)
def test_examples_of_docstrings_run(name, checkpoints, monkeypatch):
    monkeypatch.chdir(checkpoints)
    known = (
        PUBLIC
        | APPS
        | {
            "gsparc": gsparc,
            "torch": torch,
            "predictor": gsparc.load("model.ckpt"),
            "places": PLACES,
            "powers_dbm": POWERS[:, 0],
        }
    )
    tests = examples((PUBLIC | APPS)[name], name)
    assert tests, f"{name} has no example"
    report: list[str] = []
    for test in tests:
        test.globs = dict(known)
        assert not doctest.DocTestRunner().run(test, out=report.append).failed, "".join(report)
