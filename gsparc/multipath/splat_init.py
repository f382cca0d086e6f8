"""Initialise a splatted field with carrier phase: positions by source search, gains in closed form.

The loss has many local minima in phase: gradient descent from random positions fails. With positions given,
channels are linear in the emission's read-out, and a read-out of whitened kernel features is a Gaussian
process of each source's gain over places: ridge regression solves it.
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
from gsparc.multipath.directional_gp import GainKernel
from gsparc.multipath.gp_likelihood import Factor, steering
from gsparc.multipath.image_source_gp import ImageSourceGP
from gsparc.multipath.rows import Rows, gather
from gsparc.multipath.visibility_kernel import matern32

ROWS = 1000  # receivers times tones of the ridge regression
LENGTHS_M = (0.5, 1.0, 2.0, 4.0)  # over which gains may vary
CONSTANTS = (0.5, 0.8, 0.95)  # share of a gain's variance that is the same everywhere
NOISES = (0.003, 0.03, 0.3)  # of the mean power


class FromSources:
    """Gaussians at image sources or as given, gains by ridge regression; see `Initialiser`."""

    def __call__(self, task: InitTask) -> Start:
        """Search for sources, or use the given Gaussians."""
        assert task.transmitter is not None
        data, rows, transmitter = task.data, task.rows, task.transmitter
        if task.init == "backprojection":
            found = search_sources(data, rows, task.snapshot, task.seed)
            gains = fit_gain_kernel(found)
            prior = prior_of(data, rows, gains, task.anchors, task.seed)
            if not task.closed_form:
                return Start(prior, found.position)
            solve_found = partial(solve, sources=found, gains=gains, transmitter=transmitter)
            return Start(prior, found.position, solve_found)
        prior = prior_of(data, rows, UNIFORM_GAINS, task.anchors, task.seed)

        def solve_given(model: GaussianModel) -> None:
            given = assumed_sources(data, rows, model.gaussians.means.detach(), task.seed)
            solve(model, given, UNIFORM_GAINS, transmitter)

        return Start(prior, None, solve_given) if task.closed_form else Start(prior)


@dataclass(frozen=True)
class Sources:
    """Source positions and the measurements to explain.

    Attributes:
        position: (N, 3) float64 [m], local.
        power: (N,) prior variance of each gain, in units of the rows' power times m^2.
        rows: measurements without their phase offsets, unit mean power.
        scale: stored target at the carrier = scale * a row's.
    """

    position: Tensor
    power: Tensor
    rows: Rows
    scale: float


def search_sources(data: Measurements, known: np.ndarray, offsets: str, seed: int) -> Sources:
    """Sources of one search of `ImageSourceGP` on the given rows; only fixed points become Gaussians."""
    method = ImageSourceGP(
        searches=1, rows=ROWS, offsets=offsets, clutter=False, edges=False, seed=seed,  # type: ignore[arg-type]
    )  # fmt: skip
    method.fit(data, Fold(known, known[:0], known[:0]), FitContext())
    member, frame = method.members[0], method.frame
    power = member.scene.log_amplitude.double().exp().square()
    rows = replace(member.rows, position=member.rows.position + frame.middle)
    return Sources(member.scene.sources + frame.middle, power, rows, frame.scale)


def assumed_sources(data: Measurements, known: np.ndarray, means: Tensor, seed: int) -> Sources:
    """Sources of equal power at given positions (N, 3) [m]."""
    rows = gather(data, known, ROWS, seed)
    carrier = float(data.site.carrier_hz or rows.frequency.mean())
    target = rows.target * (rows.frequency / carrier)[:, None].float()
    scale = float(target.abs().square().mean().sqrt())
    rows = replace(rows, target=target / scale)
    power = steering(rows, means.double()).abs().square().mean(0).double()
    return Sources(means.double(), 1 / (len(means) * power), rows, scale)


UNIFORM_GAINS = GainKernel(length=2.0, constant=0.8, noise=0.1)  # without a search


def fit_gain_kernel(sources: Sources) -> GainKernel:
    """The kernel of largest marginal likelihood on a grid."""
    covariance, apart = _covariance(sources)
    found = {}
    for length in LENGTHS_M:
        varying = matern32((apart / length).square())
        for constant, noise in product(CONSTANTS, NOISES):
            matrix = covariance * (constant + (1 - constant) * varying)
            matrix.diagonal().add_(noise)
            found[GainKernel(constant, length, noise)] = Factor.of(matrix, sources.rows.target).nll
    return min(found, key=found.__getitem__)


def _covariance(sources: Sources) -> tuple[Tensor, Tensor]:
    """Covariance (n, n) complex64 of constant gains, and the distances (n, n) of the rows' places [m]."""
    scaled = steering(sources.rows, sources.position) * sources.power.sqrt().float()
    return scaled @ scaled.mH, torch.cdist(sources.rows.position, sources.rows.position).float()


def prior_of(data: Measurements, known: np.ndarray, gains: GainKernel, anchors: int, seed: int) -> Prior:
    """Features of the emission: up to `anchors` of the rows `known` (n,), the gains' own length."""
    rng = np.random.default_rng(seed)
    chosen = known if len(known) <= anchors else np.sort(rng.choice(known, anchors, replace=False))
    return Prior(torch.from_numpy(data.moving[chosen].astype(np.float32)), gains.length, gains.noise)


@torch.no_grad()
def solve(model: GaussianModel, sources: Sources, gains: GainKernel, transmitter: Tensor) -> None:
    """Set the emission's read-out, and the response of antennas of unknown position, by ridge regression.

    Args:
        model: Gaussians at the sources, carrier phase on, no hidden units.
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
    dual_weights = steering(rows, sources.position).conj().T * sources.power.float()[:, None]  # (N, n)
    constant = gains.constant * dual_weights @ alpha  # (N, R)
    if model.response.steering.shape[1] > 1:
        amplitude = constant.abs().square().mean(1, keepdim=True).sqrt().clamp_min(1e-20)
        each = constant / amplitude
        model.response.steering.copy_(torch.view_as_real(each.resolve_conj().contiguous()))
        alpha, constant = alpha @ each.mH / alpha.shape[1], amplitude.to(constant.dtype)
    else:
        alpha = alpha[:, :1].expand(-1, len(constant))
    weights = (1 - gains.constant) * (dual_weights * alpha.T) @ features.to(dual_weights.dtype)  # (N, width)
    attenuation = model.attenuation(model.distances(transmitter.float()[None]))
    share = torch.ones(len(weights), 1) if attenuation is None else attenuation.T
    model.emission.weight2.copy_(torch.view_as_real(weights / share))
    model.emission.bias2.copy_(torch.view_as_real(constant[:, 0] / share[:, 0]))
