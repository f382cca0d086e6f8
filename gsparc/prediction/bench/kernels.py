"""The rows that time the rasterizer: planning, blending, gradients, weights, frozen views."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.field.frozen import frozen_view
from gsparc.ops import composite, freeze, machine_limits, mean_weights, rasterize
from gsparc.ops.geometry import Pose
from gsparc.prediction.bench.measure import Call, Case, Work, size
from gsparc.prediction.bench.scene import COMPLEX, GRID, Scene, places, receiver, receivers

REFERENCE_BYTES = 3 * 2**30  # of one forward pass in dense tensors
DENSE_TENSORS = 12  # (N, H W) tensors alive at once in the reference


def moving(scene: Scene, batch: int) -> Case:
    """Time a query of a moving receiver: rasterize, as the model does (kernel); emission too (whole)."""
    # The same places in another order and moved, so that no two ends are at one place.
    poses, tx = receivers(batch), places(batch).flip(0) + 1
    features = scene.features.expand(batch, -1, -1)

    def draw(backend: str | None = None) -> Tensor:
        kind, view = scene.projection, (features, poses, GRID)
        return rasterize(*scene.geometry, *view, projection=kind, backend=backend).image

    return Case(
        *("forward, moving receiver", scene.projection, len(scene), batch),
        work=_blending(scene, poses, batch * COMPLEX), kernel=draw, whole=lambda: scene.model(tx, poses),
        **_reference(scene, batch, lambda: draw("reference")),
    )  # fmt: skip


def plan(scene: Scene, batch: int) -> Case:
    """Project, cull, order and bin."""
    poses = receivers(batch)
    layout = scene.plan(poses)
    return Case(
        *("plan", scene.projection, len(scene), batch),
        work=Work(size(scene.geometry) + size(layout.buffers)),
        kernel=lambda: scene.plan(poses),
        whole=lambda: scene.model.plan(poses),
        **_reference(scene, batch, lambda: scene.plan(poses, backend="reference")),
    )


def frozen(scene: Scene, batch: int) -> Case:
    """Time a static receiver's weights as a sparse matrix: multiply (kernel); its emissions too (whole)."""
    pose = receiver()
    view = freeze(scene.plan(pose), *scene.geometry, version=0)
    whole = frozen_view(scene.model, pose)
    features = scene.features.expand(batch, -1, -1).contiguous()
    tx, rx = places(batch) + 1, Pose.identity(places(batch))
    return Case(
        *("forward, frozen", scene.projection, len(scene), batch),
        # The matrix is read once and images are written: no exponential is left.
        work=Work(size(view.buffers) + features.nbytes + _image_bytes(batch * COMPLEX)),
        kernel=lambda: view.render(features, version=0),
        whole=lambda: whole.render(scene.model, tx, rx),
        unaffordable="a dense matrix",
    )


def backward(scene: Scene, batch: int) -> Case:
    """Time gradients of blending (kernel); a training step's forward and backward (whole)."""
    pose = receiver()
    layout = scene.plan(pose)
    means, quats, scales, opacities = (tensor.clone().requires_grad_() for tensor in scene.geometry)
    features = scene.features.expand(batch, -1, -1).clone().requires_grad_()
    leaves = (means, quats, scales, opacities, features)
    with torch.enable_grad():
        image = composite(layout, *leaves).image
    slope = torch.rand(image.shape, generator=torch.Generator().manual_seed(0))
    tx, rx = places(batch) + 1, Pose.identity(places(batch))

    def kernel() -> object:
        return torch.autograd.grad(image, leaves, slope, retain_graph=True)

    def whole() -> None:
        with torch.enable_grad():
            scene.model.zero_grad(set_to_none=True)
            values = scene.model.features(tx, rx)
            g = scene.model.gaussians.geometry()
            composite(layout, *g, values).image.backward(slope)

    def dense() -> object:
        with torch.enable_grad():
            image = composite(scene.plan(pose, backend="reference"), *leaves).image
            return torch.autograd.grad(image, leaves, slope)

    work = _blending(scene, pose, batch * COMPLEX)
    return Case(
        *("backward", scene.projection, len(scene), batch),
        # Inputs are read and gradients of the same shapes written.
        work=Work(2 * work.bytes, work.pairs),
        kernel=kernel,
        whole=whole,
        # Autograd keeps all dense tensors: of 1,000 Gaussians these are 1.6 GB.
        reference=dense if batch == 1 and len(scene) <= 1000 else None,
        unaffordable=_too_big(scene, 2),
    )


def weights(scene: Scene, batch: int) -> Case:
    """Time visible shares for channels: plan and weights (kernel)."""
    poses = receivers(batch)
    # Channels sum over all directions: their pairs are those on the full sphere.
    pairs = machine_limits.pairs(scene.plan(poses, channels=True))
    return Case(
        *("weights, moving receiver", scene.projection, len(scene), batch),
        work=Work(size(scene.geometry) + 8 * batch * len(scene), pairs),
        kernel=lambda: mean_weights(scene.plan(poses, channels=True), *scene.geometry).share,
        unaffordable=_too_big(scene, batch),
    )


def _blending(scene: Scene, poses: Pose, channels: int) -> Work:
    read = size(scene.geometry) + 4 * len(scene) * channels
    return Work(
        read + _image_bytes(channels) + _image_bytes(len(poses)), machine_limits.pairs(scene.plan(poses))
    )


def _image_bytes(planes: int) -> int:
    return 4 * planes * GRID.height * GRID.width


def _dense_bytes(scene: Scene, batch: int) -> int:
    return 4 * DENSE_TENSORS * batch * len(scene) * GRID.height * GRID.width


def _too_big(scene: Scene, batch: int) -> str:
    return f"dense tensors of {_dense_bytes(scene, batch) / 2**30:.0f} GiB"


def _reference(scene: Scene, batch: int, call: Call) -> dict:
    affordable = _dense_bytes(scene, batch) <= REFERENCE_BYTES
    return {"reference": call} if affordable else {"unaffordable": _too_big(scene, batch)}
