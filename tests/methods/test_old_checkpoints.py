"""Checkpoints written before modules were moved and renamed still load, and predict the same."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from outdated import GONE

import gsparc
from gsparc.data.schema import Batch
from gsparc.methods.checkpoint import CheckpointError, load
from gsparc.methods.reduced import reduced
from gsparc.methods.stored_front import kept
from gsparc.ops import Pose

HERE = Path(__file__).resolve().parent
FIXTURES = HERE / "old_checkpoints"
NAMES = sorted(path.stem for path in FIXTURES.glob("*.ckpt"))
KINDS = ("learned", "expected", "distance", "gp_variance")  # of confidence
READ = [name for name in NAMES if name not in GONE]
RTOL, ATOL = 2e-4, 1e-5  # the second in units of the largest value
APPROXIMATE = 2e-3  # RTOL of what is answered from images of low rank since, and ten times that of variances


@pytest.fixture(autouse=True)
def one_thread():
    """Sums in the order in which they were then."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@cache
def everything() -> dict[str, dict[str, np.ndarray]]:
    """Questions and answers by checkpoint."""
    found: dict[str, dict[str, np.ndarray]] = {}
    with np.load(FIXTURES / "expected.npz") as stored:
        for key in stored.files:
            name, _, part = key.partition("/")
            found.setdefault(name, {})[part] = stored[key]
    return found


def holding(part: str) -> list[str]:
    """Checkpoints with an answer of that kind."""
    return [name for name in READ if part in everything()[name]]


def close_to(name: str) -> float:
    return APPROXIMATE if "bearings" in name else RTOL


def check_equal(found: Any, expected: np.ndarray, what: str, rtol: float = RTOL) -> None:
    found = found.detach().numpy() if isinstance(found, torch.Tensor) else np.asarray(found)
    assert found.shape == expected.shape and found.dtype == expected.dtype, what
    scale = float(np.abs(expected).max()) if expected.size else 0.0
    least = ATOL * rtol / RTOL * max(scale, 1e-30)
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=least, err_msg=what)


def check_prediction(
    prediction: Any, known: dict[str, np.ndarray], prefix: str = "", rtol: float = RTOL
) -> None:
    for part in ("mean", "confidence", "variance"):
        value = getattr(prediction, part)
        assert (value is None) == (prefix + part not in known), prefix + part
        if value is not None:
            loose = 10 if part == "variance" and rtol == APPROXIMATE else 1
            check_equal(value, known[prefix + part], prefix + part, loose * rtol)


def question_of(known: dict[str, np.ndarray]) -> Batch:
    """The three positions, or snapshots, in local coordinates."""
    tensors = {part: torch.from_numpy(value) for part, value in known.items() if value.dtype.kind in "fc"}
    return Batch(
        index=torch.arange(3),
        tx=tensors["tx"],
        rx=Pose(tensors["rx_position"], tensors["rx_rotation"]),
        target=torch.zeros_like(tensors["mean"]),
        noise_variance=tensors.get("noise_variance"),
        uplink=tensors.get("uplink"),
    )


def in_the_world(predictor: Any, known: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same question to `gsparc.load`: world coordinates, physical units."""
    if "uplink" in known:
        return {"uplink": known["uplink"] * np.float32(predictor.site.target_scale)}
    return {predictor.site.moving_end: known["asked_at"]}


def test_nothing_is_missing():
    assert sorted(everything()) == NAMES and len(NAMES) > 40


@pytest.mark.parametrize("name", GONE)
def test_what_is_gone_is_refused_in_one_line(name):
    with pytest.raises(CheckpointError, match=GONE[name]):
        load(FIXTURES / f"{name}.ckpt")


@pytest.mark.parametrize("name", READ)
def test_predictions_are_the_same(name):
    known = everything()[name]
    method, _ = load(FIXTURES / f"{name}.ckpt")
    batch = question_of(known)
    with torch.no_grad():
        check_prediction(method.answer(batch), known, rtol=close_to(name))
        if "uplink" not in known:
            check_prediction(method.predict(batch.tx, batch.rx), known, rtol=close_to(name))


@pytest.mark.parametrize("name", sorted({*holding("asked_at"), *holding("asked")}))
def test_predictions_in_world_coordinates_are_the_same(name):
    """What is not stored apart is the method's prediction, in physical units."""
    known = everything()[name]
    predictor = gsparc.load(FIXTURES / f"{name}.ckpt")
    question = in_the_world(predictor, known)
    expected = known.get("asked", known["mean"] * np.float32(predictor.site.target_scale))
    check_equal(getattr(predictor, predictor.site.kind)(**question), expected, "asked", close_to(name))
    if "confidence" in known:
        check_equal(
            predictor.confidence(**question), known.get("sure", known["confidence"]), "sure", close_to(name)
        )


@pytest.mark.parametrize("name", holding("paths_gain"))
def test_paths_are_the_same(name):
    known = everything()[name]
    predictor = gsparc.load(FIXTURES / f"{name}.ckpt")
    found = predictor.paths(**in_the_world(predictor, known))
    for part, value in (
        ("paths_gain", found.gain),
        ("paths_delay", found.delay_s),
        ("paths_direction", found.direction),
        ("paths_cosines", found.cosines),
    ):
        assert (value is None) == (part not in known), part
        if value is not None:
            check_equal(value, known[part], part)


@pytest.mark.parametrize("name", holding("unknown_noise/mean"))
def test_predictions_from_an_uplink_of_unknown_noise_are_the_same(name):
    known = everything()[name]
    method, _ = load(FIXTURES / f"{name}.ckpt")
    check_prediction(method.from_uplink(torch.from_numpy(known["uplink"])), known, "unknown_noise/")


@pytest.mark.parametrize("name", holding("accepts"))
def test_confidence_and_acceptance_are_the_same(name):
    known = everything()[name]
    path = FIXTURES / f"{name}.ckpt"
    predictor = gsparc.load(path)
    question = in_the_world(predictor, known)
    assert predictor.trusted.promise is not None
    np.testing.assert_array_equal(predictor.accepts(**question), known["accepts"])
    for kind in KINDS:
        if f"sure_{kind}" in known:
            other, then = gsparc.load(path, confidence=kind), known[f"sure_{kind}"]
            if kind == "gp_variance":  # was 1 - variance, cut off at 0, is 1 / (1 + variance)
                assert (then > 0).all()
                then = (1 / (2 - then)).astype(np.float32)
            check_equal(other.confidence(**question), then, kind)


@pytest.mark.parametrize("name", [name for name in READ if name.startswith("traded")])
def test_reduced_models_predict_the_same(name):
    known = everything()[name]
    method, stored = load(FIXTURES / f"{name}.ckpt")
    points, measured = kept(stored.extra)
    batch, reductions = question_of(known), 0
    for number, point in enumerate(points):
        if point.settings:
            view = reduced(method, point.settings, measured)
            check_prediction(view.predict(batch.tx, batch.rx), known, f"point{number}/", close_to(name))
            reductions += 1
    assert (
        reductions == len([part for part in known if part.endswith("/mean") and part.startswith("point")]) > 0
    )
