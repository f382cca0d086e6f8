"""Powers of all terms by marginal likelihood, in a basis of what places can tell apart.

Each group's scale is profiled out. See `gsparc.models.channels.terms.compressed`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.models.channels.columns import Group
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Isotropic, Noise
from gsparc.models.channels.terms.compressed import Basis, Cache, get_or_make
from gsparc.models.channels.terms.term import ChannelTerm
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.density import TINY
from gsparc.processes.left_out import left_out_residuals as left_out_rows

# Pull of every parameter to where it started, which holds those that nothing depends on
WEAK = 1e-3
STEPS = 30
SETTLED = 1e-6  # relative change of the objective at which steps end

Grouping = list[Tensor] | None  # rows that are left out together; None: one by one


@dataclass(frozen=True)
class BasisGroup:
    """A group's signal in a basis.

    Attributes:
        group: whose, with targets of unit mean square.
        basis: (n, r) float64 of orthonormal columns.
        pieces: (p, r, r) complex128 of each term of the signal, in the order of powers; the noise
            has none.
        design: (P, Q), logarithms of own powers are its products with all parameters of signal and
            noise.
        target: (r, D) complex128.
        rest: sum of squares outside the basis.
    """

    group: Group
    basis: Tensor
    pieces: tuple[Tensor, ...]
    design: Tensor
    target: Tensor
    rest: float

    @staticmethod
    def from_group(
        group: Group, basis: Tensor, pieces: tuple[Tensor, ...], design: Tensor
    ) -> BasisGroup:
        """Return it with the group's targets in the basis."""
        target = basis.T.to(torch.complex128) @ group.target
        rest = max(float(group.target.abs().square().sum() - target.abs().square().sum()), 0.0)
        return BasisGroup(group, basis, pieces, design, target, rest)

    @property
    def is_uncompressed(self) -> bool:
        """Whether places tell so many waves apart that nothing is compressed."""
        return len(self.target) == len(self.group)

    def powers(self, prior: ChannelPrior) -> Tensor:
        """Return powers (P,) as this end has them."""
        return (self.design @ torch.cat([term.parameters() for term in learned_terms(prior)])).exp()


@dataclass(frozen=True)
class SolvedGroup:
    """A group's covariance with one set of powers, factored.

    Attributes:
        nll: negative log marginal likelihood of complex targets [nats], but for a constant.
        given: the targets in the basis, given their covariance (r, r) complex128.
        scale: mean square of the whitened targets: the group's own power.
    """

    nll: float
    given: Conditioned
    scale: float


def learned_terms(prior: ChannelPrior) -> tuple[ChannelTerm, ...]:
    """Return terms whose powers evidence knows: signal and white noise."""
    return *prior.signals, prior[Noise]


def normalise_power(group: Group) -> Group:
    """Return the same with targets of unit mean square."""
    # A silent group stays 0 instead of 0 / 0.
    level = group.target.abs().square().mean().clamp_min(TINY).sqrt()
    return replace(group, target=group.target / level)


def compress_groups(
    groups: tuple[Group, ...], prior: ChannelPrior, cache: Cache | None = None
) -> tuple[BasisGroup, ...]:
    """Return signals of all groups; of one set of displacements
    and wavelength they share the basis.

    `cache` keeps matrices of places that further candidates and groups need again.
    """
    cache, parts = {} if cache is None else cache, []
    # Relative to the diffuse field: eigenvalues of its correlation far below are lost in the noise.
    noise = prior.noise / float(prior[Isotropic].power)
    for group in groups:
        key = group.displacement_key, group.slot.wavenumber, prior.frame.envelope, noise
        alike = partial(prior[Isotropic].correlation, group, group)
        basis = get_or_make(
            cache, key, partial(Basis.from_matrix, key, group.places, alike, noise, cache)
        )
        pieces = tuple(term.unit_covariances_in_basis(group, basis) for term in prior.signals)
        design = torch.block_diag(*(term.design(group.slot) for term in learned_terms(prior)))
        parts.append(BasisGroup.from_group(group, basis.columns, pieces, design))
    return tuple(parts)


def solve_group(part: BasisGroup, power: Tensor) -> SolvedGroup:
    """Factor a group's covariance with its own powers (P,)."""
    size, noise = len(part.target), float(power[-1])
    covariance = torch.zeros(size, size, dtype=torch.complex128)
    powers = power[:-1].to(torch.complex128).split([len(piece) for piece in part.pieces])
    for piece, level in zip(part.pieces, powers, strict=True):
        covariance += torch.tensordot(level, piece, 1)
    covariance.diagonal().add_(noise)
    solution = Conditioned.from_gram(covariance, part.target)
    count, outputs = part.group.target.shape
    # Outside the basis is noise alone: its form and its determinant (below) need no matrix.
    quadratic = solution.power * part.target.numel() + part.rest / noise
    scale = max(quadratic / (count * outputs), TINY)
    determinant = float(solution.factor.log_determinant) + (count - size) * math.log(noise)
    return SolvedGroup(outputs * (count * math.log(scale) + determinant), solution, scale)


def power_gradient(part: BasisGroup, power: Tensor, at: SolvedGroup) -> Tensor:
    """Return the gradient (P,) of the negative log likelihood by logarithms of own powers."""
    count, outputs = part.group.target.shape
    weights = at.given.weights
    weight = at.given.factor.inverse.addmm(weights, weights.mH, beta=outputs, alpha=-1 / at.scale)
    noise = weight.diagonal().real.sum() + outputs * (count - len(weight)) / power[-1]
    # Slope of `rest / (scale noise)`, the quadratic form outside the basis.
    noise = noise - part.rest / (at.scale * power[-1] ** 2)
    # Traces of products of Hermitian matrices.
    slopes = [(piece.flatten(1) @ weight.mT.flatten()).real for piece in part.pieces]
    return torch.cat([*slopes, noise[None]]) * power


def negative_log_evidence(parts: tuple[BasisGroup, ...], prior: ChannelPrior) -> float:
    """Return the negative log marginal likelihood of all groups [nats]."""
    return sum(solve_group(part, part.powers(prior)).nll for part in parts)


def fit_powers(
    parts: tuple[BasisGroup, ...], prior: ChannelPrior, shrinkage: float, steps: int = STEPS
) -> tuple[ChannelPrior, float]:
    """Fit parameters of largest evidence of all `learned_terms` terms; see `fit_terms`."""
    fitted, nll = fit_terms(parts, learned_terms(prior), shrinkage, steps)
    return prior.with_terms(*fitted), nll


def fit_terms(
    parts: Sequence[BasisGroup], terms: tuple[ChannelTerm, ...], shrinkage: float, steps: int
) -> tuple[tuple[ChannelTerm, ...], float]:
    """Fit parameters of largest evidence; return its negative logarithm without the priors too.

    Args:
        parts: of the groups, whose designs have these terms' parameters.
        terms: to start from.
        shrinkage: rows that a prior of directions' powers counts for.
        steps: of L-BFGS at most.
    """
    bounds = [each for term in terms for each in term.bounds()]
    low, high = torch.tensor(bounds, dtype=torch.float64).T
    begin = torch.cat([term.parameters() for term in terms]).clamp(low, high)
    sizes = [len(term.parameters()) for term in terms]

    def negative_log_prior(at: Tensor) -> Tensor:
        each = zip(terms, at.split(sizes), strict=True)
        values = torch.stack([term.penalty(part, shrinkage) for term, part in each]).sum()
        return values + WEAK * (at - begin).square().sum()

    def cost_and_slopes(point: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.from_numpy(point).requires_grad_()
        value = negative_log_prior(at)
        (gradient,) = torch.autograd.grad(value, at)
        at, total = at.detach(), float(value.detach())
        for part in parts:
            values = (part.design @ at).exp()
            now = solve_group(part, values)
            total += now.nll
            gradient = gradient + part.design.T @ power_gradient(part, values, now)
        return total, gradient.numpy()

    optimum = minimize(
        cost_and_slopes,
        begin.numpy(),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": steps, "ftol": SETTLED},
    )
    parameters = torch.from_numpy(optimum.x)
    fitted = tuple(
        term.with_values(values)
        for term, values in zip(terms, parameters.split(sizes), strict=True)
    )
    return fitted, sum(solve_group(part, (part.design @ parameters).exp()).nll for part in parts)


def left_out_errors(part: BasisGroup, power: Tensor, groupings: list[Grouping]) -> list[Tensor]:
    """Return errors (n, D) of rows left out in groups,
    of each grouping (Rasmussen and Williams, 5.12).

    Powers (P,) are its own.
    """
    at, noise, wide = solve_group(part, power), power[-1], part.basis.to(torch.complex128)
    alpha = wide @ at.given.weights + (part.group.target - wide @ part.target) / noise
    # The inverse is that of the covariance in the basis, and 1 / noise on what is orthogonal to it.
    outside = torch.eye(len(wide), dtype=torch.float64) - part.basis @ part.basis.T
    inverse = wide @ at.given.factor.inverse @ wide.mH + outside / noise
    return [left_out_rows(inverse, alpha, groups)[0] for groups in groupings]
