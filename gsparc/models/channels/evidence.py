"""Powers of all terms by marginal likelihood, with covariances compressed to what places can tell apart.

The degrees of freedom of waves over a patch grow with its size in wavelengths (R. A. Kennedy et al.,
"Intrinsic limits of dimensionality and richness in random multipath fields", IEEE Trans. Signal Process. 55
(2007)) and are often far fewer than rows; the eigenvectors U of the isotropic field hold all of them, and
outside of them there is noise alone. Each group's scale is profiled out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gsparc.models.channels.columns import Group
from gsparc.models.channels.covariance import Values, angle_knot_weights, directions, waves_of
from gsparc.models.channels.kernels import envelope, plain, smooth
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.factor import Factor
from gsparc.processes.kernel import apart
from gsparc.processes.left_out import left_out as left_out_rows
from gsparc.processes.worker import stop_when_late

FLOOR = 1e-3  # of the noise: powers of eigenvectors that are left out
WORTH = 0.8  # of the rows, number of eigenvectors from which compression is not worth it
LOW_RANK = 1e-6  # of the largest eigenvalue of a gain's correlation, those left out
LOWEST, HIGHEST = -14.0, 7.0  # logarithms of powers
LOW = 0.3  # of the rows, columns of a factor up to which its product is not kept
WEAK = 1e-3  # pull of every log power to where it started, which holds those that nothing depends on
TILTED = 0.5  # pull of logarithms of factors towards ends to 0: a prior of standard deviation 1
STEPS = 30
SETTLED = 1e-6  # relative change of the objective at which steps end

Cache = dict[tuple[bytes | float, ...], Any]
Grouping = list[Tensor] | None  # rows that are left out together; None: one by one


@dataclass(frozen=True)
class Term:
    """A term F F^H of a covariance (r, r).

    Attributes:
        factor: F (r, q) complex128.
        product: (r, r) complex128, kept where F has so many columns that it saves time.
    """

    factor: Tensor
    product: Tensor | None

    @staticmethod
    def of(factor: Tensor) -> Term:
        """From F."""
        return Term(factor, factor @ factor.mH if factor.shape[1] > LOW * len(factor) else None)

    def added(self, covariance: Tensor, power: Tensor) -> Tensor:
        """The covariance with this term of some power."""
        if self.product is not None:
            return covariance.add_(self.product * power)
        return covariance.addmm_(self.factor * power, self.factor.mH)

    def trace(self, weight: Tensor) -> Tensor:
        """Trace () of its product with a Hermitian matrix (r, r)."""
        if self.product is not None:
            return torch.view_as_real(self.product).mul(torch.view_as_real(weight)).sum()
        return (self.factor.conj() * (weight @ self.factor)).real.sum()


@dataclass(frozen=True)
class Compressed:
    """A group's terms in the basis.

    Attributes:
        group: whose, with targets of unit mean square.
        basis: (n, r) float64 of orthonormal columns.
        room: (1 + M, r, r) complex128, the isotropic field and those of directions.
        terms: of leakage, direct wave and images, in the order of `Shape.names`.
        ways: (M, J), see `covariance.angle_knot_weights`; J is 0 where directions are of the room alone.
        target: (r, D) complex128.
        rest: sum of squares outside the basis.
    """

    group: Group
    basis: Tensor
    room: Tensor
    terms: tuple[Term, ...]
    ways: Tensor
    target: Tensor
    rest: float

    def own(self, power: Tensor, towards: Tensor) -> Tensor:
        """Powers (P,) as this end has them, of powers (P,) that all share."""
        if not len(towards):
            return power
        room = len(self.room)
        return torch.cat([power[:1], power[1:room] * (self.ways @ towards).exp(), power[room:]])


@dataclass(frozen=True)
class Solved:
    """A group's covariance with one set of powers, factored.

    Attributes:
        nll: negative log marginal likelihood of complex targets [nats], but for a constant.
        given: the targets in the basis, given their covariance (r, r) complex128.
        scale: mean square of the whitened targets: the group's own power.
    """

    nll: float
    given: Conditioned
    scale: float


def normalised(group: Group) -> Group:
    """The same with targets of unit mean square."""
    level = group.target.abs().square().mean().sqrt().clamp_min(1e-150)
    return replace(group, target=group.target / level)


def compressed(
    groups: tuple[Group, ...], values: Values, cache: Cache | None = None
) -> tuple[Compressed, ...]:
    """Terms of all groups; those of one set of displacements and one wavelength share the diffuse field's.

    `cache` keeps matrices of places that further candidates and groups need again.
    """
    cache, parts = {} if cache is None else cache, []
    noise = float(values.of("noise")[0] / values.of("isotropic")[0])
    for group in groups:
        places = group.displacements
        kernel = group.slot.wavenumber, float(values.envelope), noise, values.concentration
        key = (places, *kernel, values.angles.numpy().tobytes())
        if key not in cache:
            cache[key] = _field(group, values, noise)
        basis, room = cache[key]
        for length in (values.reach, float(values.gain)):
            if (places, length) not in cache:
                cache[places, length] = _roots(group, length)
        roots = cache[places, values.reach], cache[places, float(values.gain)]
        terms = tuple(map(Term.of, _factors(group, values, basis, *roots)))
        bins = torch.zeros(len(values.angles), 0, dtype=torch.float64)
        if len(values.towards):
            bins = angle_knot_weights(values, (group.slot.end + values.offset)[None], len(values.towards))[0]
        parts.append(Compressed(group, basis, room, terms, bins, *_projected(group, basis)))
    return tuple(parts)


def _projected(group: Group, basis: Tensor) -> tuple[Tensor, float]:
    """Targets (r, D) in a basis (n, r), and the sum of squares outside it."""
    target = basis.T.to(torch.complex128) @ group.target
    return target, max(float(group.target.abs().square().sum() - target.abs().square().sum()), 0.0)


def compressible(group: Group, values: Values) -> bool:
    """Whether the places tell far fewer waves apart than there are rows."""
    noise = float(values.of("noise")[0] / values.of("isotropic")[0])
    alike = plain(group.places, group.places, group.slot.wavenumber, values.envelope)
    return int((torch.linalg.eigvalsh(alike) > FLOOR * noise).sum()) <= WORTH * len(group)


def _field(group: Group, values: Values, noise: float) -> tuple[Tensor, Tensor]:
    places, wavenumber = group.places, group.slot.wavenumber
    distance = apart(places, places)
    bound = envelope(distance, values.envelope)
    alike = plain(places, places, wavenumber, values.envelope)
    size, vectors = torch.linalg.eigh(alike)
    mask = size > FLOOR * noise
    whole = int(mask.sum()) > WORTH * len(group)
    basis = torch.eye(len(group), dtype=torch.float64) if whole else vectors[:, mask]
    room = [alike.to(torch.complex128)]
    for angle in values.angles:
        one = directions(angle[None], values.concentration, wavenumber, places, places, distance)
        room.append(one[0] * bound)
    if whole:
        return basis, torch.stack(room)
    # The basis is real: two real products take half the time of a complex one.
    return basis, torch.stack(
        [torch.complex(basis.T @ each.real @ basis, basis.T @ each.imag @ basis) for each in room]
    )


def _roots(group: Group, length: float) -> Tensor:
    """F (n, q) with F F^T the correlation of gains that vary over `length` [m]."""
    size, vectors = torch.linalg.eigh(smooth(apart(group.places, group.places), length))
    mask = size > LOW_RANK * size[-1]
    return vectors[:, mask] * size[mask].sqrt()


def _factors(
    group: Group, values: Values, basis: Tensor, fixed: Tensor, varying: Tensor
) -> tuple[Tensor, ...]:
    wide = basis.T.to(torch.complex128)
    columns = [wide @ fixed.to(torch.complex128)] if values.constant else []
    waves = waves_of(values, group.slot, group.places)[:, :, None]
    for part in waves.split([int(values.direct), values.count]):
        columns += [wide @ (wave * root) for root in (fixed, varying) for wave in part]
    return tuple(columns)


def without(part: Compressed, left: Tensor) -> Compressed:
    """The rows but those of `left` (n,) bool, from the same matrices."""
    rest = torch.nonzero(~left).flatten()
    basis, mixed = torch.linalg.qr(part.basis[rest])
    room = torch.complex(mixed @ part.room.real @ mixed.T, mixed @ part.room.imag @ mixed.T)
    wide = mixed.to(torch.complex128)
    group = part.group.take(rest)
    terms = tuple(Term.of(wide @ term.factor) for term in part.terms)
    return Compressed(group, basis, room, terms, part.ways, *_projected(group, basis))


def solved(part: Compressed, power: Tensor) -> Solved:
    """With its own powers (P,), those of correlated noise ignored."""
    room = len(part.room)
    noise = power[room + len(part.terms)]
    size = part.room.shape[1:]
    covariance = (power[:room].to(torch.complex128) @ part.room.view(room, -1)).view(size)
    for level, term in zip(power[room:], part.terms, strict=False):
        covariance = term.added(covariance, level)
    covariance.diagonal().add_(noise)
    given = Conditioned.of(covariance, part.target)
    count, outputs = part.group.target.shape
    quadratic = given.scale * part.target.numel() + part.rest / float(noise)
    scale = max(quadratic / (count * outputs), 1e-300)
    determinant = float(given.factor.log_determinant) + (count - len(covariance)) * math.log(float(noise))
    return Solved(outputs * (count * math.log(scale) + determinant), given, scale)


def slope(part: Compressed, power: Tensor, at: Solved) -> Tensor:
    """Gradient (P,) of the negative log likelihood by log powers."""
    count, outputs = part.group.target.shape
    weights = at.given.weights
    weight = at.given.factor.inverse.addmm(weights, weights.mH, beta=outputs, alpha=-1 / at.scale)
    room = len(part.room)
    gradient = torch.zeros_like(power)
    gradient[:room] = (part.room.reshape(room, -1) @ weight.T.reshape(-1)).real
    for number, term in enumerate(part.terms, room):
        gradient[number] = term.trace(weight)
    noise = room + len(part.terms)
    gradient[noise] = weight.diagonal().real.sum() + outputs * (count - len(weight)) / power[noise]
    gradient[noise] -= part.rest / (at.scale * power[noise] ** 2)
    return gradient * power


def evidence(parts: tuple[Compressed, ...], values: Values) -> float:
    """Negative log marginal likelihood of all groups [nats]."""
    return sum(solved(part, part.own(values.power, values.towards)).nll for part in parts)


def fit_powers(
    parts: tuple[Compressed, ...], values: Values, shrinkage: float, steps: int = STEPS
) -> tuple[Values, float]:
    """With powers and `Values.towards` of largest evidence, its negative logarithm without the priors.

    Args:
        parts: of the groups.
        values: to start from.
        shrinkage: rows that an inverse Gamma prior of directions' powers about their mean counts for.
        steps: of L-BFGS at most.
    """
    start, towards = values.power, values.towards
    count = len(start)
    begin = torch.cat([start.log().clamp(LOWEST, HIGHEST), towards])
    angles = values.where("direction")

    def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
        log = torch.from_numpy(logs)
        power, tilt, total = log[:count].exp(), log[count:], 0.0
        gradient = torch.zeros_like(log)
        for part in parts:
            own = part.own(power, tilt)
            at = solved(part, own)
            total += at.nll
            part_slope = slope(part, own, at)
            gradient[:count] += part_slope
            if len(tilt):
                gradient[count:] += part.ways.T @ part_slope[1 : len(part.room)]
        total += TILTED * float(tilt.square().sum())
        gradient[count:] += 2 * TILTED * tilt
        if angles and shrinkage > 0:
            mean = power[angles].mean()
            ratio = mean / power[angles]
            total += shrinkage * float((ratio - ratio.log()).sum())
            pull = (ratio.sum() / mean - len(angles) / mean) * power[angles] / len(angles)
            gradient[angles] += shrinkage * (1 - ratio + pull)
        total += WEAK * float((log - begin).square().sum())
        return total, (gradient + 2 * WEAK * (log - begin)).numpy()

    bounds = [(LOWEST, HIGHEST)] * count + [(-HIGHEST, HIGHEST)] * len(towards)
    part_slope = minimize(
        objective,
        begin.numpy(),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": steps, "ftol": SETTLED},
        callback=stop_when_late,
    )
    power, towards = torch.from_numpy(part_slope.x[:count]).exp(), torch.from_numpy(part_slope.x[count:])
    fitted = replace(values, power=power, towards=towards)
    return fitted, evidence(parts, fitted)


def left_out(part: Compressed, power: Tensor, groupings: list[Grouping]) -> list[Tensor]:
    """Errors (n, D) of rows left out with their group, of each grouping (Rasmussen and Williams 2006, 5.12).

    Powers (P,) are its own.
    """
    at, noise = solved(part, power), power[len(part.room) + len(part.terms)]
    wide, inverse = part.basis.to(torch.complex128), at.given.factor.inverse
    alpha = wide @ at.given.weights + (part.group.target - wide @ part.target) / noise
    errors = []
    for groups in groupings:
        if groups is None:
            inside, outside = (wide @ inverse) * wide.conj(), 1 - wide.abs().square().sum(1)
            error, _ = left_out_rows(inside.sum(1).real + outside / noise, alpha)
        else:
            error = torch.empty_like(alpha)
            for mine in groups:
                own = wide[mine]
                block = own @ (inverse @ own.mH) - own @ own.mH / noise
                block.diagonal().add_(1 / noise)
                error[mine] = Factor.of(block).solved(alpha[mine])
        errors.append(error)
    return errors
