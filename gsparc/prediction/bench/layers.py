"""The rows that time what stands around the rasterizer: networks, channels, the loss, an optimiser step."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from gsparc.field.emission import Emission, EmissionSettings
from gsparc.field.losses import spectrum_loss
from gsparc.field.model import GaussianModel
from gsparc.field.optimizer import OptimizerSettings, optimizer_for
from gsparc.ops import Pose, mean_weights
from gsparc.ops.channels import channels, summed
from gsparc.ops.networks import networks, products
from gsparc.ops.projection import Projection
from gsparc.prediction.bench.measure import Call, Case, Work, size
from gsparc.prediction.bench.scene import GRID, NETWORK, PAPER, Scene, places, receiver, receivers, scene

TONES = (2.4e9, 312_500.0)  # first subcarrier and spacing [Hz]
MANY = (64, 26)  # antennas and subcarriers of the Argos release: 1,664 channels
NAMES = {PAPER: "emission 3-16-2", NETWORK: "emission 63-32-2"}


def emission(count: int, batch: int, settings: EmissionSettings = PAPER) -> Case:
    """Time networks of N Gaussians at B positions (kernel); with encoding and activation (whole)."""
    model = scene(count, "tangent", settings).model
    layers = _layers(model.emission)
    where = places(batch)
    encoded = model.emission.encoding(where)
    return Case(
        *(NAMES[settings], "-", count, batch),
        work=_work(layers, encoded, count, batch),
        kernel=lambda: networks(encoded, *layers),
        whole=lambda: model.emission(where, model.distances(where)),
        reference=lambda: products(encoded, *layers),
    )


def emission_backward(count: int, batch: int) -> Case:
    """Time gradients of the networks' weights, the forward pass included."""
    model = scene(count, "tangent").model
    layers = [layer.requires_grad_() for layer in _layers(model.emission)]
    encoded = model.emission.encoding(places(batch))
    slope = torch.rand((batch, count, 2), generator=torch.Generator().manual_seed(0))

    def gradients(call) -> object:
        with torch.enable_grad():
            return torch.autograd.grad(call(encoded, *layers), layers, slope)

    once = _work(layers, encoded, count, batch)
    return Case(
        *("emission 3-16-2, backward", "-", count, batch),
        # Both passes read the weights, and the second one writes their gradients.
        work=Work(2 * once.bytes + size(layers)),
        kernel=lambda: gradients(networks),
        reference=lambda: gradients(products),
    )


def loss(batch: int) -> Case:
    """Time L1 and SSIM of B spectra with their gradient."""
    draw = torch.Generator().manual_seed(0)
    shape = (batch, GRID.height, GRID.width)
    target = torch.rand(shape, generator=draw)
    prediction = torch.rand(shape, generator=draw).requires_grad_()

    def kernel() -> object:
        with torch.enable_grad():
            return torch.autograd.grad(spectrum_loss(prediction, target).sum(), prediction)

    def convolved() -> object:
        with torch.enable_grad():
            ssim = structural_similarity_index_measure(prediction[:, None], target[:, None], data_range=1.0)
            assert isinstance(ssim, Tensor)
            return torch.autograd.grad(ssim + (prediction - target).abs().mean(), prediction)

    return Case(
        *("loss of spectra, backward", "-", 0, batch),
        # Prediction and target are read forwards and backwards, and the gradient is written.
        work=Work(5 * target.nbytes),
        kernel=kernel,
        reference=convolved,
    )


def channel(field: Scene, antennas: int, subcarriers: int) -> Case:
    """Time antennas x subcarriers at a moving receiver: the factored sum (kernel); the query (whole)."""
    count, draw = len(field), torch.Generator().manual_seed(0)
    steering = torch.randn(count, antennas, 2, generator=draw)
    # Up to 100 ns, as in a room, and in float64: at 2.4 GHz these are 240 turns.
    delays = 1e-7 * torch.rand(count, generator=draw, dtype=torch.float64)
    gains = torch.randn(1, count, 2, generator=draw)
    poses, tx = receivers(1), places(1) + 1

    def whole() -> Tensor:
        share = mean_weights(field.plan(poses, channels=True), *field.geometry).share
        emitted = field.model.features(tx, poses)
        return channels(share.unsqueeze(-1) * emitted, steering, delays, *TONES, subcarriers)

    return Case(
        *(f"channel of {antennas} x {subcarriers}", field.projection, count, 1),
        work=Work(size((gains, steering, delays)) + 8 * antennas * subcarriers),
        kernel=lambda: channels(gains, steering, delays, *TONES, subcarriers),
        whole=whole,
        reference=lambda: summed(gains, steering, delays, TONES, subcarriers),
    )


def _layers(module: Emission) -> list[Tensor]:
    return [p.detach() for p in (module.weight1, module.bias1, module.weight2, module.bias2)]


def _work(layers: list[Tensor], encoded: Tensor, count: int, batch: int) -> Work:
    return Work(size(layers) + encoded.nbytes + 4 * batch * count * 2)


COUNT, BATCH = 100, 16  # as many Gaussians as the dense tensors of plain PyTorch leave memory for


def step(projection: Projection, count: int = COUNT, batch: int = BATCH) -> Case:
    """Time emission, plan, blending, L1 and SSIM, gradients and Adam; the reference in PyTorch."""
    model = scene(count, projection).model
    parameters = 4 * sum(parameter.numel() for parameter in model.parameters())
    return Case(
        *("training step", projection, count, batch),
        work=Work(7 * parameters + 8 * batch * GRID.height * GRID.width),  # Adam: four read, three written
        kernel=_learning(model, batch),
        reference=_learning(scene(count, projection, backend="reference").model, batch),
    )


def _learning(model: GaussianModel, batch: int) -> Call:
    optimizer = optimizer_for(model, OptimizerSettings())
    draw = torch.Generator().manual_seed(0)
    target = torch.rand((batch, GRID.height, GRID.width), generator=draw)
    tx, rx = places(batch) + 1, Pose.identity(places(batch))

    def call() -> Tensor:
        with torch.enable_grad():
            optimizer.zero_grad(set_to_none=True)
            values = model.features(tx, rx)[..., :1]
            image = model.raster(values, receiver()).image
            loss = spectrum_loss(image.squeeze(1), target).mean()
            loss.backward()
            optimizer.step()
        return loss.detach()

    return call
