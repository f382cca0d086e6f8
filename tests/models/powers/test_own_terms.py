"""A term of a user's own, of examples/own-term: learned, stored, read back, refused."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import gsparc
from gsparc.models.checkpoint import CheckpointError
from gsparc.processes import term

FILE = Path(__file__).parents[3] / "examples" / "own-term" / "trees.py"
STILL = [300.0, -100.0, 20.0]  # far from the origin of local coordinates
GROVE = [[310.0, -120.0], [340.0, -120.0], [340.0, -80.0], [310.0, -80.0]]


@pytest.fixture
def trees(monkeypatch):
    spec = importlib.util.spec_from_file_location("trees", FILE)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "trees", module)
    spec.loader.exec_module(module)
    yield module.Trees
    term._KINDS.pop("Trees", None)


def town(count: int = 160) -> dict[str, np.ndarray]:
    """Powers beside and behind a grove that takes .4 dB a metre."""
    rng = np.random.default_rng(0)
    at = np.c_[rng.uniform(345, 400, count), rng.uniform(-180, -20, count), np.full(count, 1.5)]
    way = at - STILL
    # The left and right edges are met first and last where a path is not too steep, else the long ones.
    enter = np.maximum(10 / way[:, 0], 0)
    leave = np.minimum(40 / way[:, 0], 20 / np.maximum(abs(way[:, 1]), 1e-9))
    inside = np.maximum(leave - enter, 0) * np.linalg.norm(way, axis=1)
    level = -30 - 25 * np.log10(np.linalg.norm(way, axis=1)) - 0.4 * inside + rng.normal(0, 1, count)
    return {"rx": at, "rssi": level, "inside": inside}


def test_the_length_inside_a_polygon_is_that_of_its_clipped_path(trees):
    data = town()
    found = trees(GROVE, STILL).columns(torch.from_numpy(data["rx"]))[:, 0].numpy()
    np.testing.assert_allclose(found, 0.1 * data["inside"], atol=1e-9)


def test_a_term_of_ones_own_is_learned_stored_and_read(trees, tmp_path):
    data, path = town(), tmp_path / "model.ckpt"
    known = {"rx": data["rx"][:40], "tx": STILL, "rssi": data["rssi"][:40], "model": "powers"}
    asked, truth = data["rx"][40:], data["rssi"][40:]
    plain = gsparc.fit(**known)
    entry = {"term": "trees.Trees", "corners": GROVE, "still": STILL}
    for given in (trees(GROVE, STILL), entry):
        own = gsparc.fit(**known, settings={"terms": [given]}, save=path)
        errors = [np.std(one.rssi(rx=asked)[:, 0] - truth) for one in (own, plain)]
        assert errors[0] < 0.9 * errors[1], errors
        np.testing.assert_allclose(gsparc.load(path).rssi(rx=asked), own.rssi(rx=asked), atol=1e-5)
    term._KINDS.pop("Trees")
    with pytest.raises(CheckpointError, match="no term is called 'Trees': import the file that defines it"):
        gsparc.load(path)


@pytest.mark.parametrize("entry, why", [
    ({"term": "trees.Bushes"}, "'trees.Bushes' is no class"),
    ({"term": "trees.Trees", "corners": []}, "missing 1 required positional argument: 'still'"),
    (3, "3 is not a gsparc.processes.term.Columns"),
])  # fmt: skip
def test_what_is_no_term_is_refused(trees, entry, why):
    data = town()
    with pytest.raises(ValueError, match=why):
        gsparc.fit(rx=data["rx"], tx=STILL, rssi=data["rssi"], model="powers", settings={"terms": [entry]})
