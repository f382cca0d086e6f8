"""What a method declares by the protocols of `gsparc.methods.method`, and that it keeps to it.

Every method was fitted once, on tiny data: the checkpoints of `old_checkpoints`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from rooms import shoebox

from gsparc.data.splits import Fold
from gsparc.methods import method as protocols
from gsparc.methods.checkpoint import Stored, load
from gsparc.methods.method import Differentiable, FitContext, Method, Reducible
from gsparc.methods.registry import METHODS
from gsparc.methods.stored_front import kept
from gsparc.multipath import complex_gp
from gsparc.ops import Pose
from gsparc.peers.calibrated_raytracer import CalibratedRayTracer

FIXTURES = Path(__file__).parent / "old_checkpoints"
FILES = {  # of methods whose name has changed since
    "moving_array": "bearings", "image_source_gp": "vsgp", "directional_gp": "directed",
    "gsparc": "gsparc_field", "array": "traded_array_field",
    "nerf2": "nerf2_trunk",
}  # fmt: skip
DECLARED = {
    **dict.fromkeys(("zero", "mean", "nearest", "idw", "kriging", "ridge", "fire", "uplink"), ""),
    **dict.fromkeys(("gsrf", "wrfgs", "swiftwrf", "nerf2", "ngrf", "newrf"), ""),
    "calibrated_raytracer": "",
    "distance_law": "Differentiable",
    "gp": "Differentiable Reducible",
    "complex_gp": "Differentiable LeaveOneOut",
    "directional_gp": "Differentiable LeaveOneOut HasPaths",
    "image_source_gp": "LeaveOneOut HasPaths Reducible",
    "array": "Differentiable Reducible",
    "moving_array": "Reducible",
    "gsparc": "Differentiable HasPaths Reducible",
}
VARIANCE = (
    "kriging", "distance_law", "gp", "complex_gp", "directional_gp", "image_source_gp", "array",
    "moving_array",
)  # fmt: skip
PROTOCOLS = sorted({word for words in DECLARED.values() for word in words.split()})
SMOOTH = {
    "gsparc": ["gsparc_field"],
    "gp": ["gp", "gp_power_process"],
    "array": ["traded_array_field"],
}


def having(protocol: str) -> list[str]:
    return [name for name, words in DECLARED.items() if protocol in words.split()]


@cache
def read(file: str) -> tuple[Method, Stored]:
    return load(FIXTURES / f"{file}.ckpt")


def fitted(name: str) -> Method:
    if name == "calibrated_raytracer":  # fitted where a scene and Sionna are: tests/peers
        return CalibratedRayTracer()
    return read(FILES.get(name, name))[0]


def places(method: Method, count: int = 5) -> torch.Tensor:
    """Of the moving end (count, 3) float64 [m], in the scene's box."""
    assert method.site is not None
    low, high = torch.from_numpy(method.site.box).double()
    draw = torch.Generator().manual_seed(0)
    return low + (0.2 + 0.6 * torch.rand(count, 3, generator=draw, dtype=torch.float64)) * (high - low)


def ends(method: Method, moving: torch.Tensor) -> tuple[torch.Tensor, Pose]:
    """Both ends, the moving one at places (B, 3); the static one where it stood."""
    site = method.site
    assert site is not None
    still = torch.zeros(3) if site.static_position is None else torch.from_numpy(site.static_position).float()
    if site.moving_end == "rx":
        return still.expand(len(moving), 3), Pose.identity(moving)
    turn = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    return moving, Pose(still, torch.from_numpy(turn).float())


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_what_the_table_says(name):
    kept_to = {word for word in PROTOCOLS if isinstance(fitted(name), getattr(protocols, word))}
    assert kept_to == set(DECLARED[name].split())
    assert fitted(name).resumable == (name in ("image_source_gp", "gsparc"))


@pytest.mark.parametrize("name", VARIANCE)
def test_predictions_have_a_variance(name):
    method = fitted(name)
    variance = method.predict(*ends(method, places(method).float())).variance
    assert variance is not None and variance.shape == (5,)
    assert variance.dtype == torch.float32 and (variance > 0).all()


@pytest.mark.parametrize(
    "file", [file for name in having("Differentiable") for file in SMOOTH.get(name, [name])]
)
def test_gradients_are_those_of_the_predicted_mean(file):
    method = read(FILES.get(file, file))[0]
    assert isinstance(method, Differentiable)
    # What is computed in float32 is asked in float32, with steps that rounding does not hide.
    exact = not file.startswith(("gsparc", "traded"))
    where = places(method).to(torch.float64 if exact else torch.float32)
    with torch.no_grad():
        said, mean = method.predict(*ends(method, where)).mean, method.mean_at(*ends(method, where))
    assert method.site is not None
    shown = mean.clamp(0, 1) if method.site.kind == "spectrum" else mean  # spectra are shown clamped
    torch.testing.assert_close(shown, said, rtol=1e-4, atol=1e-5 * float(said.abs().max()))
    draw = torch.Generator().manual_seed(1)
    weights = torch.randn(mean.shape, generator=draw, dtype=mean.dtype)

    def summed(moving: torch.Tensor) -> torch.Tensor:
        """A sum (B,) of the mean's entries, in float64."""
        product = method.mean_at(*ends(method, moving)) * weights
        return torch.real(product).double().flatten(1).sum(1)

    asked = where.clone().requires_grad_()
    (slope,) = torch.autograd.grad(summed(asked).sum(), asked)
    step = 3e-4 if exact else 3e-3
    with torch.no_grad():
        for axis in torch.eye(3, dtype=where.dtype):
            found = (summed(where + step * axis) - summed(where - step * axis)) / (2 * step)
            wanted = (slope * axis).sum(1).double()
            torch.testing.assert_close(found, wanted, rtol=0.02, atol=0.02 * float(slope.abs().max()))
    assert slope.abs().max() > 0


@pytest.mark.parametrize(
    "file", ["gsparc_phase", "gsparc_field_channels", "gsparc_field_moving", "gsparc_field_power"]
)
def test_what_has_no_gradients_says_so(file):
    """Footprints are projected without any: a moving receiver's would lack most of what changes."""
    method = read(file)[0]
    assert isinstance(method, Differentiable)
    with pytest.raises(ValueError, match="no gradients"):
        method.mean_at(*ends(method, places(method).float().requires_grad_()))


def test_left_out_rows_are_predicted_by_a_fit_without_them(monkeypatch):
    _, data, fold = shoebox(24)
    known = np.concatenate([fold.train, fold.val])
    none = known[:0]

    def fit(rows: np.ndarray) -> complex_gp.ComplexGP:
        method = complex_gp.ComplexGP()
        method.fit(data, Fold(rows, none, none), FitContext())
        return method

    monkeypatch.setattr(complex_gp, "LENGTHS", (1.0,))  # a row less must not choose another kernel
    monkeypatch.setattr(complex_gp, "NOISES", (1e-2,))
    residual = fit(known).leave_one_out().residual
    for number in (0, len(known) // 2, len(known) - 1):
        batch = data.batch(known[[number]])
        missed = batch.target - fit(np.delete(known, number)).predict(batch.tx, batch.rx).mean
        torch.testing.assert_close(residual[number].to(missed.dtype), missed.flatten(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("file", "settings"),
    [
        ("traded_gp", {"keep": 0.5, "confidence": False}),
        ("traded_array_field", {"anchors": 0.5}),
        ("traded_bearings", {"keep": 0.5}),
        ("traded", {"keep": 0.5, "confidence": False}),
    ],
)
def test_a_reduction_leaves_the_method_as_it_was(file, settings):
    method, stored = read(file)
    assert isinstance(method, Reducible) and set(settings) <= set(method.knobs())
    query = ends(method, places(method).float())
    before = method.predict(*query)
    less = method.reduced(settings, kept(stored.extra)[1])
    assert not torch.equal(less.predict(*query).mean, before.mean)
    after = method.predict(*query)
    for part in ("mean", "confidence", "variance"):
        one, two = getattr(before, part), getattr(after, part)
        assert (one is None and two is None) or torch.equal(one, two)
