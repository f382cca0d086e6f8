"""Materials learned in a known scene; tracing is slow,
and skipped with its remedy without Sionna.
"""

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch
from refusals import refused

from gsparc.data.splits import Fold
from gsparc.models import checkpoint, loading
from gsparc.models.peers import calibrated_raytracer
from gsparc.models.peers.calibrated_raytracer import CalibratedRayTracer
from gsparc.simulate import llvm
from gsparc.simulate.calibration import (
    Material,
    Replay,
    apply_materials,
    fit_gain_and_scale,
    student_loss,
    used_materials,
)
from gsparc.simulate.effects import Effects
from gsparc.simulate.raytracer import RayTracer
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.settings import SceneSettings
from gsparc.tables.own import from_arrays
from gsparc.training.context import FitContext

STATION = np.array([-2.5, 0.0, 3.0])
CARRIER_HZ = 3.5e9
PLAIN = Effects(
    diffraction=False, edge_diffraction=False, diffuse=False, polarisation=False, depth=2
)
TRUE = Material(4.0, 0.2)
GAIN_DB = 17.0
ALL = np.arange(60)
FOLD = Fold(ALL[:40], ALL[40:45], ALL[45:])


def places(count: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform([-4, -4, 0.5], [4, 4, 4], (count, 3))


def measurements(power: np.ndarray, **attributes):
    arrays = {"rssi": power, "rx_position": places(len(power)), "tx_position": STATION}
    return from_arrays(arrays | {"carrier_hz": np.array(CARRIER_HZ)}, attributes)


def said(scene: SceneSettings) -> dict[str, str]:
    return {"scene": json.dumps(asdict(scene))}


def test_slopes_of_the_residuals_density():
    residual, scale = np.array([-20.0, -1.0, 0.3, 5.0]), 2.5
    slopes = student_loss(residual, scale)[1]
    for row, step in enumerate(1e-5 * np.eye(4)):
        change = student_loss(residual + step, scale)[0] - student_loss(residual - step, scale)[0]
        assert slopes[row] == pytest.approx(change / 2e-5, rel=1e-6)


def test_gain_and_scale_are_the_likeliest():
    rng = np.random.default_rng(0)
    missed = 7 + 3 * rng.standard_t(4, 200)
    gain, scale = fit_gain_and_scale(missed)
    least = student_loss(gain - missed, scale)[0]
    assert gain == pytest.approx(7, abs=0.8) and scale == pytest.approx(3, rel=0.2)
    for other in (
        (gain + 0.1, scale),
        (gain - 0.1, scale),
        (gain, scale * 1.03),
        (gain, scale / 1.03),
    ):
        assert student_loss(other[0] - missed, other[1])[0] > least


@pytest.mark.parametrize(
    "scene, words",
    [
        (None, "name no scene of triangles; say model.scene="),
        ("nowhere.osm", "nowhere.osm is not here"),
    ],
)
def test_where_no_scene_is_known_it_says_so_in_one_line(scene, words):
    method = CalibratedRayTracer(scene=scene)
    error = refused(words, method.fit, measurements(np.ones(60)), FOLD, FitContext())
    assert str(error).startswith("calibrated_raytracer: ")


def test_without_the_ray_tracer_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(llvm.SimulatorMissing, match="make sionna") as raised:
        CalibratedRayTracer(scene="floor_wall").fit(measurements(np.ones(60)), FOLD, FitContext())
    assert "\n" not in str(raised.value)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ValueError):
        CalibratedRayTracer(steps=-1)


def test_other_data_are_refused():
    own = measurements(np.ones(60))
    unknown = from_arrays({"rssi": np.ones(60), "rx_position": places(), "tx_position": STATION})
    assert CalibratedRayTracer().why_not(own) is None
    assert "carrier" in CalibratedRayTracer().why_not(unknown)


@pytest.fixture(scope="module")
def wall():
    try:
        llvm.prepare_llvm()
    except llvm.SimulatorMissing as missing:
        pytest.skip(str(missing))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrated_raytracer, "SAMPLING", Sampling(20_000, 100))
        patch.setattr(calibrated_raytracer, "EFFECTS", PLAIN)
        yield RayTracer("floor_wall", STATION, CARRIER_HZ, Sampling(20_000, 100))


@pytest.mark.slow
def test_gradients_are_the_powers_own(wall):
    """Every slope by a material equals a difference of the likelihood."""
    names = list(used_materials(wall))
    replay = Replay(wall, places(), PLAIN)
    weights = np.random.default_rng(1).normal(size=60)
    at = {name: TRUE.logarithms() + 0.3 * number for number, name in enumerate(names)}

    def value(levels: dict[str, np.ndarray]) -> tuple[float, np.ndarray]:
        return replay.cost_and_gradient(levels, lambda db: (float(weights @ db), weights))

    slopes = value(at)[1]
    assert len(slopes) == 2 * len(names) and np.abs(slopes).max() > 0.1
    for number, slope in enumerate(slopes):
        name, which = names[number // 2], number % 2
        step = 0.02 * np.eye(2)[which]
        up, down = (value({**at, name: at[name] + sign * step})[0] for sign in (1, -1))
        assert slope == pytest.approx((up - down) / 0.04, rel=0.03, abs=0.02 * np.abs(slopes).max())


@pytest.mark.slow
def test_it_predicts_where_nobody_measured_and_is_stored(wall, tmp_path):
    apply_materials(wall, dict.fromkeys(used_materials(wall), TRUE))
    power = wall.trace(places(), PLAIN).received_power() * 10 ** (GAIN_DB / 10)
    scene = SceneSettings("floor_wall", 30, CARRIER_HZ, 0.0, 1, builtin="floor_wall")
    data = measurements(power, **said(scene))
    test = data.batch(FOLD.test)
    error = {}
    for steps in (0, 60):
        method = CalibratedRayTracer(steps=steps)
        assert method.fit(data, FOLD, FitContext()).seconds > 0
        said_db, true_db = (
            10 * torch.log10(v[:, 0]) for v in (method.predict(test).mean, test.target)
        )
        error[steps] = float((said_db - true_db).square().mean().sqrt())
    assert error[60] < 0.3 and error[60] < 0.5 * error[0]
    config = "model: {_target_: gsparc.models.peers.calibrated_raytracer.CalibratedRayTracer}"
    checkpoint.save(tmp_path / "model.ckpt", method, config)
    again, _ = loading.load(tmp_path / "model.ckpt")
    torch.testing.assert_close(
        again.predict(test).mean, method.predict(test).mean, rtol=1e-4, atol=0
    )
