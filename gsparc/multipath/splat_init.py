"""Where a splatted field with carrier phase starts: sources found by search, gains in closed form.

The phase makes bad minima: from random places and weights gradient descent learns nothing. Once places are
given, channels are linear in the emission's read-out, and a read-out of whitened kernel features is a
Gaussian process of each source's gain over places: ridge regression solves all of it at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.field.encoding import Prior
from gsparc.field.initial import InitTask, Start
from gsparc.field.model import GaussianModel
from gsparc.field.response import PathResponse
from gsparc.methods.method import FitContext
from gsparc.multipath.gp_likelihood import Factor, steering
from gsparc.multipath.image_source_gp import VirtualSourceGP
from gsparc.multipath.rows import Rows, gather
from gsparc.multipath.visibility_kernel import matern32

ROWS = 1000  # receivers times tones the gains are solved on
LENGTHS_M = (0.5, 1.0, 2.0, 4.0)  # over which gains may vary
CONSTANTS = (0.5, 0.8, 0.95)  # share of a gain's variance that is the same everywhere
NOISES = (0.003, 0.03, 0.3)  # of the mean power


class FromSources:
    """Gaussians at image sources of a search, or as placed, gains by ridge regression; see `Initialiser`."""

    def __call__(self, task: InitTask) -> Start:
        """Search, or take the Gaussians as they will stand."""
        assert task.transmitter is not None
        data, rows, transmitter = task.data, task.rows, task.transmitter
        if task.init == "backprojection":
            found = searched(data, rows, task.snapshot, task.seed)
            gains = likeliest(found)
            prior = prior_of(data, rows, gains, task.anchors, task.seed)
            if not task.closed_form:
                return Start(prior, found.position)
            settle = partial(solve, sources=found, gains=gains, transmitter=transmitter)
            return Start(prior, found.position, settle)
        prior = prior_of(data, rows, UNIFORM_GAINS, task.anchors, task.seed)

        def solve_there(model: GaussianModel) -> None:
            there = anywhere(data, rows, model.gaussians.means.detach(), task.seed)
            solve(model, there, UNIFORM_GAINS, transmitter)

        return Start(prior, None, solve_there) if task.closed_form else Start(prior)


@dataclass(frozen=True)
class Sources:
    """Places of sources and the measurements they are to explain.

    Attributes:
        position: (N, 3) float64 [m], local.
        power: (N,) prior variance of each gain, in units of the rows' power times m^2.
        rows: measurements without their snapshots' own phases, unit mean power.
        scale: stored target at the carrier = scale * a row's.
    """

    position: Tensor
    power: Tensor
    rows: Rows
    scale: float


def searched(data: Measurements, known: np.ndarray, offsets: str, seed: int) -> Sources:
    """One search of the virtual-source process on the given rows; only fixed points become Gaussians."""
    method = VirtualSourceGP(
        searches=1, rows=ROWS, offsets=offsets, clutter=False, edges=False, seed=seed,  # type: ignore[arg-type]
    )  # fmt: skip
    method.fit(data, Fold(known, known[:0], known[:0]), FitContext())
    member, frame = method.members[0], method.frame
    scene = member.scene
    return Sources(
        scene.sources + frame.middle,
        scene.log_amplitude.double().exp().square(),
        member.rows.moved(frame.middle),
        frame.scale,
    )


def anywhere(data: Measurements, known: np.ndarray, means: Tensor, seed: int) -> Sources:
    """Sources that are just assumed, all alike: means (N, 3) [m]."""
    rows = gather(data, known, ROWS, seed)
    carrier = float(data.site.carrier_hz or rows.frequency.mean())
    target = rows.target * (rows.frequency / carrier)[:, None].float()
    scale = float(target.abs().square().mean().sqrt())
    rows = replace(rows, target=target / scale)
    loud = steering(rows, means.double()).abs().square().mean(0).double()
    return Sources(means.double(), 1 / (len(means) * loud), rows, scale)


@dataclass(frozen=True)
class Gains:
    """How gains vary, as the likelihood has it: correlation length [m], constant share, noise."""

    length: float
    constant: float
    noise: float


UNIFORM_GAINS = Gains(length=2.0, constant=0.8, noise=0.1)  # where no search has told


def likeliest(sources: Sources) -> Gains:
    """The combination of largest marginal likelihood."""
    covariance, apart = _covariance(sources)
    found = {}
    for length in LENGTHS_M:
        varying = matern32((apart / length).square())
        for constant, noise in product(CONSTANTS, NOISES):
            matrix = covariance * (constant + (1 - constant) * varying)
            matrix.diagonal().add_(noise)
            found[Gains(length, constant, noise)] = Factor.of(matrix, sources.rows.target).nll
    return min(found, key=found.__getitem__)


def _covariance(sources: Sources) -> tuple[Tensor, Tensor]:
    """Covariance (n, n) complex64 of constant gains, and the distances (n, n) of the rows' places [m]."""
    scaled = steering(sources.rows, sources.position) * sources.power.sqrt().float()
    return scaled @ scaled.mH, torch.cdist(sources.rows.position, sources.rows.position).float()


def prior_of(data: Measurements, known: np.ndarray, gains: Gains, anchors: int, seed: int) -> Prior:
    """Features of the emission: up to `anchors` of the rows `known` (n,), the gains' own length."""
    rng = np.random.default_rng(seed)
    chosen = known if len(known) <= anchors else np.sort(rng.choice(known, anchors, replace=False))
    return Prior(torch.from_numpy(data.moving[chosen].astype(np.float32)), gains.length, gains.noise)


@torch.no_grad()
def solve(model: GaussianModel, sources: Sources, gains: Gains, transmitter: Tensor) -> None:
    """Set the emission's read-out, and what antennas of unknown place make of it, by ridge regression.

    Args:
        model: its Gaussians stand at the sources; carrier phase on, no hidden units.
        sources, gains: as found.
        transmitter: (3,) [m].

    Raises:
        ValueError: the emission has hidden units.
    """
    if model.settings.emission.hidden:
        raise ValueError("model.warm_start=true solves a linear read-out: set model.emission.hidden=0")
    assert isinstance(model.response, PathResponse)
    rows = sources.rows
    features = model.emission.encoding(rows.position.float())
    matrix = _covariance(sources)[0] * (gains.constant + (1 - gains.constant) * features @ features.mT)
    matrix.diagonal().add_(gains.noise)
    alpha = Factor.of(matrix, rows.target).alpha * sources.scale
    pulled = steering(rows, sources.position).conj().T * sources.power.float()[:, None]  # (N, n)
    constant = gains.constant * pulled @ alpha  # (N, R)
    if model.response.steering.shape[1] > 1:
        loud = constant.abs().square().mean(1, keepdim=True).sqrt().clamp_min(1e-20)
        each = constant / loud
        model.response.steering.copy_(torch.view_as_real(each.resolve_conj().contiguous()))
        alpha, constant = alpha @ each.mH / alpha.shape[1], loud.to(constant.dtype)
    else:
        alpha = alpha[:, :1].expand(-1, len(constant))
    weights = (1 - gains.constant) * (pulled * alpha.T) @ features.to(pulled.dtype)  # (N, width)
    attenuation = model.attenuation(model.distances(transmitter.float()[None]))
    share = torch.ones(len(weights), 1) if attenuation is None else attenuation.T
    model.emission.weight2.copy_(torch.view_as_real(weights / share))
    model.emission.bias2.copy_(torch.view_as_real(constant[:, 0] / share[:, 0]))
