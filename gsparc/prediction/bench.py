"""The kernels as `gsparc bench` times them: a room of N Gaussians around a receiver,
beside plain PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from gsparc.data.schema import Site
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.losses import spectrum_loss
from gsparc.field.model import AttenuationSettings, GaussianModel, ModelSettings, RasterSettings
from gsparc.field.optimizer import OptimizerSettings, optimizer_for
from gsparc.ops import (
    Cutoff,
    Plan,
    Pose,
    SphereGrid,
    composite,
    freeze,
    make_plan,
    mean_weights,
    rasterize,
)
from gsparc.ops.projection import Projection

Call = Callable[[], object]
ROOM = np.array([[-8.0, -6.0, -3.0], [8.0, 6.0, 3.0]])  # [m]
GRID = SphereGrid.hemisphere()
EMISSION = EmissionSettings(
    EncodingSettings("raw"), 16, "sigmoid", log_distance=True, init_bias=0.0
)
# Dense tensors of one forward pass of 1,000 Gaussians are 1.6 GB:
# the reference of more is not called.
MOST_DENSE = 1000
STEPPED, BATCH = 100, 16  # Gaussians and spectra of a training step


@dataclass(frozen=True)
class Case:
    """A kernel at one size, and the same in plain PyTorch;
    None where its dense tensors are too large.
    """

    name: str
    size: str
    kernel: Call
    reference: Call | None = None


def random_model(
    count: int, projection: Projection, backend: str | None = None, device: str = "cpu"
) -> GaussianModel:
    """Return a room of `count` Gaussians of all shapes,
    from nearly transparent to nearly opaque (seeded).
    """
    site = Site(
        name="bench",
        kind="spectrum",
        static_end="tx",
        grid=GRID,
        array=None,
        carrier_hz=None,
        subcarriers_hz=None,
        origin=np.zeros(3),
        box=ROOM,
        moving_box=ROOM,
        sha256="",
    )
    settings = ModelSettings(
        FieldSettings(count=count, placement="uniform", margin=0.0),
        EMISSION,
        AttenuationSettings(inverse_distance=True),
        raster=RasterSettings(projection, backend=backend),
    )
    # Seeded without touching the draws of whoever calls.
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(count)
        model = GaussianModel(settings, site)
        field = model.gaussians
        field.log_scales.add_(torch.randn_like(field.log_scales), alpha=0.5)
        # Normal numbers, once they are normalised, are uniform rotations.
        field.quats.copy_(torch.randn_like(field.quats))
        field.opacity_logits.copy_(1.5 * torch.randn_like(field.opacity_logits) - 1)
    return model.to(device)


def kernel_cases(count: int, projection: Projection, device: str = "cpu") -> Iterator[Case]:
    """Yield the kernels of a field of N Gaussians, two real channels wide."""
    model = random_model(count, projection, device=device)
    means, quats, scales, opacities = (t.detach() for t in model.gaussians.geometry())
    geometry = means, quats, scales, opacities
    pose = Pose.identity(torch.tensor([0.5, -0.5, 0.2])).to(device)
    draw = torch.Generator().manual_seed(0)
    features = torch.rand(1, count, 2, generator=draw).to(device)
    size = f"{count} {projection}"

    def make_case(name: str, call: Callable[[str | None], object]) -> Case:
        return Case(
            *(name, size, lambda: call(None)),
            (lambda: call("reference")) if count <= MOST_DENSE else None,
        )

    def forward(backend: str | None) -> Tensor:
        return rasterize(
            *geometry, features, pose, GRID, projection=projection, backend=backend
        ).image

    def backward(backend: str | None) -> object:
        leaves = [tensor.clone().requires_grad_() for tensor in (*geometry, features)]
        with torch.enable_grad():
            of = leaves[0], leaves[1], leaves[2], leaves[3], leaves[4]
            image = rasterize(*of, pose, GRID, projection=projection, backend=backend).image
            return torch.autograd.grad(image.sum(), leaves)

    def weights(backend: str | None) -> Tensor:
        # Channels sum over all directions, at half the resolution of images.
        sphere, cutoff = SphereGrid.full_sphere(90, 180), Cutoff(1e-3, relative=True)
        seen = make_plan(
            *geometry, pose, sphere, projection=projection, cutoff=cutoff, backend=backend
        )
        return mean_weights(seen, *geometry).share

    def plan(backend: str | None) -> Plan:
        return make_plan(*geometry, pose, GRID, projection=projection, backend=backend)

    yield make_case("plan", plan)
    yield make_case("plan and blend, moving receiver", forward)
    frozen = freeze(plan(None), *geometry, version=0)
    # Plain PyTorch has no frozen views: its own plan, made once, is composited.
    dense = plan("reference") if count <= MOST_DENSE else None

    def again() -> Tensor:
        assert dense is not None
        return composite(dense, *geometry, features).image

    reference = None if dense is None else again
    yield Case(
        "blend, static receiver", size, lambda: frozen.render(features, version=0), reference
    )
    yield make_case("forward and gradients", backward)
    yield make_case("weights of channels", weights)


def loss_case(device: str = "cpu") -> Case:
    """Return L1 and SSIM of a batch of spectra with their gradient."""
    draw = torch.Generator().manual_seed(0)
    target, image = (
        torch.rand((BATCH, GRID.height, GRID.width), generator=draw).to(device) for _ in range(2)
    )
    image.requires_grad_()

    def convolved() -> Tensor:
        ssim = structural_similarity_index_measure(image[:, None], target[:, None], data_range=1.0)
        assert isinstance(ssim, Tensor)
        return ssim + (image - target).abs().mean()

    def gradient(of: Callable[[], Tensor]) -> Call:
        return lambda: torch.autograd.grad(of(), image)

    return Case(
        "loss of spectra",
        str(BATCH),
        gradient(lambda: spectrum_loss(image, target).sum()),
        gradient(convolved),
    )


def training_step_case(projection: Projection, count: int = STEPPED, device: str = "cpu") -> Case:
    """Return a training step: emission, plan, blending, loss, gradients and Adam."""
    ours, plain = (
        _make_step(random_model(count, projection, backend, device))
        for backend in (None, "reference")
    )
    return Case("training step", f"{count} {projection} x {BATCH}", ours, plain)


def _make_step(model: GaussianModel) -> Callable[[], Tensor]:
    optimizer, draw = optimizer_for(model, OptimizerSettings()), torch.Generator().manual_seed(0)
    device = model.gaussians.means.device
    target = torch.rand((BATCH, GRID.height, GRID.width), generator=draw).to(device)
    tx, rx = torch.randn(BATCH, 3, generator=draw).to(device), torch.zeros(3, device=device)

    def call() -> Tensor:
        optimizer.zero_grad(set_to_none=True)
        image = model.rasterize(model.emissions(tx, Pose.identity(tx)), Pose.identity(rx)).image
        result = spectrum_loss(image.squeeze(1), target).mean()
        result.backward()
        optimizer.step()
        return result.detach()

    return call
