"""Processes of complex channels at fixed settings."""

from __future__ import annotations

import numpy as np
import torch
from gains import phased
from rooms import directed
from small_worlds import CARRIER, ceiling, channel, fold

from gsparc.data.splits import Fold
from gsparc.models.channels import complex_gp, evidence
from gsparc.models.channels.columns import gather, thinned
from gsparc.models.channels.covariance import Shape, Values
from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.kernels import cells, sphere
from gsparc.models.directional import method as directional_gp
from gsparc.models.image_sources.clutter.residual import Residual
from gsparc.models.image_sources.gp_likelihood import Posterior
from gsparc.models.image_sources.query import Query
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import Scene
from gsparc.models.image_sources.visibility_gp import VisibilityGP
from gsparc.models.image_sources.visibility_kernel import KernelVisibility
from gsparc.ops import Pose
from gsparc.processes.left_out import groups_of
from gsparc.training.context import FitContext

Arrays = dict[str, np.ndarray]


def _seen(found: object) -> Arrays:
    names = ("mean", "variance", "confidence", "unknown", "explained")
    return {
        name: getattr(found, name).detach().numpy()
        for name in names
        if getattr(found, name, None) is not None
    }


def _complex_gp(runs: int) -> Arrays:
    data = channel(60, tones=2, runs=runs)
    model, found = complex_gp.ComplexGP(), {}
    complex_gp.LENGTHS, complex_gp.NOISES, kept = (4.0,), (1e-2,), (complex_gp.LENGTHS, complex_gp.NOISES)
    try:
        model.fit(data, fold(60, 10), FitContext())
    finally:
        complex_gp.LENGTHS, complex_gp.NOISES = kept
    batch = data.batch(np.arange(50, 60))
    found |= _seen(model.answer(batch))
    found["factors"] = model.runs.factors.numpy()
    found["left_out"] = model.leave_one_out().residual.numpy()
    found["power"] = np.array(model.kernel.amplitude)
    at = batch.rx.position.double().requires_grad_()
    mean = model.predict(batch.tx.double(), Pose(at, batch.rx.rotation)).mean
    (slope,) = torch.autograd.grad(mean.real.sum(), at)
    return found | {"slope": slope.numpy()}


def complex_gp_of_one_run() -> Arrays:
    """`model=complex_gp`, length and noise as given."""
    return _complex_gp(1)


def complex_gp_of_three_runs() -> Arrays:
    """The same with a factor of each run."""
    return _complex_gp(3)


def complex_gp_given_nearest_rows() -> Arrays:
    """The same where each query is told by its nearest rows."""
    data = channel(400)
    model = complex_gp.ComplexGP()
    names = ("LENGTHS", "NOISES", "MOST_ROWS", "NEAREST")
    kept = {name: getattr(complex_gp, name) for name in names}
    try:
        complex_gp.LENGTHS, complex_gp.NOISES, complex_gp.MOST_ROWS, complex_gp.NEAREST = (
            (4.0,),
            (1e-2,),
            300,
            40,
        )
        model.fit(data, fold(400, 10), FitContext())
        batch = data.batch(np.arange(390, 400))
        found = _seen(model.predict(batch.tx, batch.rx))
        left = model.leave_one_out().residual.to(torch.complex64)  # of channels in single precision
        return found | {"left_out": left.numpy()}
    finally:
        for name, value in kept.items():
            setattr(complex_gp, name, value)


def _rows(outputs: int = 1) -> Rows:
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 3, (30, 3))
    position[1], frequency, receiver = position[0], np.full(30, CARRIER), np.arange(30)
    frequency[1], receiver[1] = CARRIER + 1e7, 0
    target = (rng.standard_normal((30, outputs, 2)) @ [1, 1j]).astype(np.complex64)
    return Rows(*map(torch.from_numpy, (position, frequency, target, receiver)))


def _scene() -> Scene:
    return Scene(
        transmitter=torch.tensor([4.0, 1.0, 1.0], dtype=torch.float64),
        planes=torch.tensor([[1.0, 0, 0, -1], [0, 1, 0, 4]], dtype=torch.float64),
        sequences=((), (0,), (0, 1)),
        log_amplitude=torch.tensor([0.5, 0.2, -0.1]),
        log_noise=-1.5,
        visibility=KernelVisibility(0.7, 0.6, 1.5),
    )


def image_sources_circular() -> Arrays:
    """Covariance, weights and likelihood of image sources, whole and without one."""
    posterior = Posterior(_rows(2), _scene())
    return {
        "covariance": posterior.covariance.numpy(), "weights": posterior.conditioned.weights.numpy(),
        "nll": np.array([posterior.nll, posterior.without(1)], np.float32),
        "slope": posterior.conditioned.slope.numpy(),
    }  # fmt: skip


def image_sources_phased() -> Arrays:
    """Gains of constant phase: weights, likelihood, left-out rows, predictions and their variance."""
    posterior = Posterior(_rows(), phased(_scene(), torch.tensor([0.3, -1.0, 2.0])))
    query = torch.from_numpy(np.random.default_rng(1).uniform(0, 3, (6, 3)))
    means, variance, prior = Query([posterior]).means(query, torch.tensor([CARRIER, CARRIER + 1e7]).double())
    return {
        "weights": posterior.dual_weights.numpy(), "nll": np.array(posterior.conditioned.nll, np.float32),
        "left_out": posterior.left_out().numpy(),
        "slope": posterior.conditioned.slope.numpy(),
        "mean": means.numpy(), "variance": variance.numpy(), "prior": prior.numpy(),
    }  # fmt: skip


def residual_of_a_scene() -> Arrays:
    """What clutter is sought against: likelihood, what each source is worth, scores of changes."""
    rows, scene = _rows(), phased(_scene(), torch.tensor([0.3, -1.0, 2.0]))
    residual = Residual(rows, scene)
    share = torch.linspace(0.4, 1, 90).view(3, 30)
    level = scene.log_amplitude
    scorer = residual.scorer(share, level)
    gain, multiple = scorer.score_waves(scene.waves(rows))
    return {
        "nll": residual.nll(share, level).float().numpy().reshape(1),
        "worth": residual.nats_per_source(share, level).numpy(), "weights": scorer.alpha.numpy(),
        "score": scorer.score(scene.waves(rows)).numpy(), "gain": gain.numpy(), "by": multiple.numpy(),
    }  # fmt: skip


def visibility_of_sources() -> Arrays:
    """One process a source on labels 0 and 1."""
    rng = np.random.default_rng(4)
    places = torch.from_numpy(rng.uniform(0, 4, (50, 3)))
    seen = (places[:, :1] + torch.from_numpy(rng.uniform(-1, 1, (50, 3))) > 2).double()
    process = VisibilityGP.of(places, seen)
    query = torch.from_numpy(rng.uniform(0, 4, (8, 3)))
    return {
        "left_out": process.left_out.numpy(), "length": process.length.numpy(),
        "probability": process.probability(query).numpy(),
    }  # fmt: skip


def triangulated_sources() -> Arrays:
    """`model=directional_gp` restored from settings: mean, variance, left-out rows."""
    data, _, _ = directed(60)
    rows = np.arange(60)
    model = directional_gp.DirectionalGP()
    kernels, model_kernels = directional_gp.KERNELS, (directional_gp.GainKernel(0.97, 2.0, 0.01),)
    directional_gp.KERNELS = model_kernels
    try:
        model.fit(data, Fold(rows[:40], rows[:0], rows[40:]), FitContext())
    finally:
        directional_gp.KERNELS = kernels
    batch = data.batch(rows[40:])
    found = _seen(model.predict(batch.tx, batch.rx))
    found.pop("variance")  # in single precision a small difference from the prior: the confidence says it
    left = model.leave_one_out()
    predicted = data.target[left.rows].reshape(left.residual.shape) - left.residual.numpy()
    return found | {"left_out": predicted, "power": model.power.numpy()}


def _field(data: object, angles: int, correlated: bool, mirrors: int, tilt: int = 0) -> ChannelField:
    middle = torch.from_numpy(data.moving).mean(0)
    shape = Shape(sphere(angles), 5.0, True, True, correlated, middle, 20.0, ((0,),)[:mirrors])
    power = torch.linspace(0.2, 1.1, len(shape.names), dtype=torch.float64)
    planes = torch.tensor([[0.1, 0.0, 1.0, -0.7]], dtype=torch.float64)[:mirrors]
    planes = planes / planes[:, :3].norm(dim=1, keepdim=True)
    envelope, gain = torch.tensor([0.4, 0.3], dtype=torch.float64)
    offset = torch.tensor([0.01, -0.02, 0.0], dtype=torch.float64)
    values = Values(
        **shape.state(), power=power, envelope=envelope, gain=gain, offset=offset,
        towards=torch.linspace(1, -1, tilt).double(), planes=planes,
    )  # fmt: skip
    field = ChannelField(data.site, values, tuple(data.target.shape[1:]))
    field.condition(data, np.arange(len(data) - 8))
    return field


def _answers(field: ChannelField, data: object) -> Arrays:
    batch = data.batch(np.arange(len(data) - 8, len(data)))
    found = _seen(field.answer(batch))
    left = field.left_out()
    found |= {"left_out": left.mean.numpy(), "left_variance": left.variance.numpy()}
    some = data.batch(np.arange(0, len(data) - 8, 2))
    loss = field.loss(some).sum()
    slopes = torch.autograd.grad(loss, [field.log_power, field.log_envelope, field.log_gain, field.offset])
    found |= {"loss": loss.detach().numpy(), "slope": torch.cat([s.reshape(-1) for s in slopes]).numpy()}
    return found | {"factors": field.runs.factors.numpy()}


def waves_of_one_end() -> Arrays:
    """Every term of a channel's closed-form field."""
    data = channel(50, tones=2)
    return _answers(_field(data, 4, True, 1), data)


def waves_of_three_runs() -> Arrays:
    """The same with a factor of each run."""
    data = channel(50, runs=3)
    return _answers(_field(data, 4, True, 0), data)


def waves_of_four_antennas() -> Arrays:
    """The same through an array that moves."""
    data = channel(40, antennas=4)
    return _answers(_field(data, 0, False, 0), data)


def waves_of_three_ends() -> Arrays:
    """Antennas above a transmitter, powers of directions by their angles to each."""
    data = ceiling()
    field = _field(data, 8, False, 1, tilt=4)
    found = _answers(field, data)
    batch = data.batch(np.arange(5))
    far = Pose(batch.rx.position + torch.tensor([0.3, 0.2, 0.1]), batch.rx.rotation)
    return found | {f"unheard_{name}": value for name, value in _seen(field(batch.tx, far)).items()}


def evidence_of_waves() -> Arrays:
    """Compressed evidence, its slopes, and rows left out in cells."""
    data = channel(120)
    field, found = _field(data, 4, False, 1), {}
    groups = tuple(map(evidence.normalised, thinned(gather(data, np.arange(120), True), 1, 110)))
    values = field._constants
    (part,) = evidence.compressed(groups, values)
    at = evidence.solved(part, values.power)
    found |= {"nll": np.array(at.nll), "scale": np.array(at.scale)}
    found["slope"] = evidence.slope(part, values.power, at).numpy()
    places = groups[0].places.numpy()
    for depth in (0, 2):
        groups = groups_of(cells(places, depth + 1)) if depth else None
        found[f"cells{depth}"] = evidence.left_out(part, values.power, [groups])[0].numpy()
    return found
