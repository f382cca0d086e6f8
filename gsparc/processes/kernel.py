"""Terms that depend on distance, and their sum with noise: differentiable in places,
lengths and shares.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar, Self, cast

import numpy as np
import torch
from torch import Tensor

from gsparc.ops.transforms import needs_reference
from gsparc.processes.matern import matern32, matern52
from gsparc.processes.places import first_end, other_end
from gsparc.processes.stored import Stored
from gsparc.processes.term import Term

LENGTH_SPAN = (1e-3, 3.0)  # bounds of a length, of the median distance between rows
NOISE_SPAN = (1e-6, 1e2)  # bounds of the noise's variance, of the amplitude
SHARES = 6.0  # bound of the logit of a share
# Of the variance; minimises the held-out error on training spectra, flat from 0.1 to 0.3
ROUGH_SHARE = 0.15
ROUGH_RATIO = 1 / 3  # of the lengths
COMPILED = 2  # terms that compiled kernels sum


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Return distances (..., n, m) [m] of places (..., n, D) and (..., m, D), with gradients;
    exact at 0.

    Differences are formed before squaring: the expanded form loses millimetres in float32.

    >>> distances(torch.zeros(1, 3), torch.tensor([[3.0, 4.0, 0.0]]))
    tensor([[5.]])
    """
    if not needs_reference(a, b):
        return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    # `cdist` has no forward mode
    squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)
    none = squared == 0
    # The inner `where` keeps the root's slope at 0, which is infinite, out of the gradient.
    return torch.where(none, 0.0, torch.where(none, 1.0, squared).sqrt())


def median_distance(distance: Tensor) -> float:
    """Return the median of distances (...) [m], of rows at few places the largest,
    of those at one 1.
    """
    return float(np.median(distance.numpy())) or float(distance.max()) or 1.0


@dataclass(frozen=True)
class Stationary(Term[Tensor]):
    """A term of places that depends on their distance alone.

    Attributes:
        length: [m].
        share: variance, of that of all such terms of a kernel.
    """

    length: Tensor | float
    share: Tensor | float = 1.0
    by_distance: ClassVar[bool] = True
    compiled: ClassVar[int] = 0  # sign of its length in compiled kernels; 0: they do not know it

    @abstractmethod
    def correlation(self, distance: Tensor) -> Tensor:
        """Return correlations at distances (...) [m]."""

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """See `Term`."""
        return self.share * self.correlation(distances(a, b))

    def parameters(self) -> Tensor:
        """Return the logarithm of the length (1,); shares are learned by the sum."""
        return torch.tensor([self.length], dtype=torch.float64).log()

    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """See `Term`."""
        return [(math.log(scale * LENGTH_SPAN[0]), math.log(scale * LENGTH_SPAN[1]))]

    def with_values(self, parameters: Tensor) -> Self:
        """See `Term`."""
        return replace(self, length=to_number(parameters[0].exp()))


class Shadowing(Stationary):
    """Shadows of `length`, Matern-3/2: values have a slope.

    >>> Shadowing(2.0).correlation(torch.tensor([0.0, 2.0]))
    tensor([1.0000, 0.4834])
    """

    compiled = 1

    def correlation(self, distance: Tensor) -> Tensor:
        """See `Stationary`."""
        return matern32(distance, self.length)


class ExponentialShadowing(Stationary):
    """Shadows of `length`, Matern-1/2: rough at any scale (M. Gudmundson, Electronics Letters 27
    (1991)).

    >>> ExponentialShadowing(2.0).correlation(torch.tensor([0.0, 2.0]))
    tensor([1.0000, 0.3679])
    """

    compiled = -1

    def correlation(self, distance: Tensor) -> Tensor:
        """See `Stationary`."""
        return (distance * (-1 / self.length)).exp()


@dataclass(frozen=True)
class EndShadowing(Shadowing):
    """The same about one of two ends that both move, whatever the other does: its surroundings,
    its gain.

    >>> near = torch.tensor([[0.0, 0, 0, 9, 9, 9]])  # one transmitter, another receiver
    >>> EndShadowing(2.0).covariance(near, torch.tensor([[0.0, 0, 0, 5, 5, 5]]))
    tensor([[1.]])

    Attributes:
        other: whether it is the second end.
    """

    other: bool = False
    by_distance = False
    compiled = 0

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """See `Term`; of places (..., 6) of both ends [m]."""
        end = other_end if self.other else first_end
        return super().covariance(end(a), end(b))


class SmoothRough(Stationary):
    """A smooth long part, Matern-5/2, and a rough short one, Matern-3/2 of a third of `length`."""

    def correlation(self, distance: Tensor) -> Tensor:
        """See `Stationary`."""
        rough = matern32(distance, ROUGH_RATIO * self.length)
        return torch.lerp(matern52(distance, self.length), rough, ROUGH_SHARE)


@dataclass(frozen=True)
class IsotropicWaves(Stationary):
    """`sin(kd) / (kd) Matern-3/2(d / length)`: waves from everywhere alike.

    Where both ends move it is the product over both, as waves leave in all directions as they
    arrive from all (R. K. Cook et al., J. Acoust. Soc. Am. 27 (1955)).

    >>> waves = IsotropicWaves(length=1e6, wavenumber=2 * math.pi)  # of 1 m wavelength
    >>> others = torch.tensor([[0, 0, 0.75], [0.25, 0, 0]])
    >>> waves.covariance(torch.zeros(1, 3), others).round(decimals=3)
    tensor([[-0.2120,  0.6370]])

    Attributes:
        wavenumber: [rad/m].
    """

    wavenumber: float = 0.0
    by_distance = False

    def correlation(self, distance: Tensor) -> Tensor:
        """See `Stationary`; of one end."""
        # `torch.sinc` has pi in its argument: sin(pi x) / (pi x).
        return torch.sinc(distance * (self.wavenumber / math.pi)) * matern32(distance, self.length)

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return correlations (..., n, m) of places (..., n, 3), (..., m, 3) of one end,
        or 6 of both [m].
        """
        ends = zip(a.split(3, -1), b.split(3, -1), strict=True)
        first, *other = (self.correlation(distances(*pair)) for pair in ends)
        return first * other[0] if other else first


@dataclass(frozen=True)
class WhiteNoise(Term[Tensor]):
    """Noise of each measurement alone, also of several at one place.

    Attributes:
        share: variance, of that of all other terms of a kernel.
    """

    share: Tensor | float

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """See `Term`; 0 between rows that are not the same ones."""
        alike = a.new_zeros(len(a), len(b))
        return self.share * (alike.fill_diagonal_(1.0) if a is b else alike)

    def parameters(self) -> Tensor:
        """Return the logarithm of the share (1,)."""
        return torch.tensor([self.share], dtype=torch.float64).log()

    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """See `Term`."""
        return [(math.log(NOISE_SPAN[0]), math.log(NOISE_SPAN[1]))]

    def with_values(self, parameters: Tensor) -> Self:
        """See `Term`."""
        return replace(self, share=to_number(parameters[0].exp()))


@dataclass(frozen=True)
class Kernel(Stored):
    """`amplitude (sum of terms)`, white noise the last of them.

    >>> kernel = Kernel.from_lengths(lengths=(5.0, 50.0), shares=(0.4, 0.6), noise=0.1)

    One place: its variance and that of the noise:

    >>> kernel.gram(torch.zeros(1, 2, dtype=torch.float64))
    tensor([[1.1000]], dtype=torch.float64)
    >>> torch.allclose(kernel.with_values(kernel.parameters()).parameters(), kernel.parameters())
    True

    Attributes:
        terms: several `Stationary`, or one of any kind, whose shares sum to 1; then `WhiteNoise`.
        amplitude: variance of a value without noise.
    """

    terms: tuple[Term[Tensor], ...]
    amplitude: float = 1.0

    @classmethod
    def from_length(
        cls, length: float, noise: float, amplitude: float = 1.0, term: type[Stationary] = Shadowing
    ) -> Self:
        """Return a kernel of one term of a length [m] and of noise."""
        return cls((term(length), WhiteNoise(noise)), amplitude)

    @classmethod
    def from_lengths(
        cls, lengths: Sequence[float], shares: Sequence[float], noise: float, amplitude: float = 1.0
    ) -> Self:
        """Return a kernel of several `Shadowing` and of noise."""
        return cls((*map(Shadowing, lengths, shares), WhiteNoise(noise)), amplitude)

    @classmethod
    def of_ends(cls, path: float, end: float, noise: float) -> Self:
        """Return a kernel of a path's shadows and of those of each end alone, of lengths [m]."""
        terms = Shadowing(path), EndShadowing(end), EndShadowing(end, other=True)
        return cls((*(replace(term, share=1 / 3) for term in terms), WhiteNoise(noise)))

    @property
    def signals(self) -> tuple[Stationary, ...]:
        """Terms of distance without the noise."""
        return cast(tuple[Stationary, ...], self.terms[:-1])

    @property
    def noise(self) -> float:
        """Variance of the noise, relative to `amplitude`; a tensor while it is learned."""
        return cast(WhiteNoise, self.terms[-1]).share  # type: ignore[return-value]

    @property
    def lengths(self) -> tuple[float, ...]:
        """Lengths of the terms [m]."""
        return tuple(float(term.length) for term in self.signals)

    @property
    def shares(self) -> tuple[float, ...]:
        """Shares of the terms."""
        return tuple(float(term.share) for term in self.signals)

    @property
    def length(self) -> float:
        """The first [m]."""
        return self.lengths[0]

    @property
    def description(self) -> str:
        """One line of lengths and noise.

        >>> Kernel.from_lengths((0.5, 2.0), (0.25, 0.75), noise=0.1).description
        "lengths 0.5 m (25%) and 2 m (75%), noise 0.1 of the signal's variance"
        """
        parts = [f"{length:.4g} m" for length in self.lengths]
        if len(parts) > 1:
            parts = [
                f"{part} ({share:.0%})" for part, share in zip(parts, self.shares, strict=True)
            ]
        ends = [" of each end" if isinstance(term, EndShadowing) else "" for term in self.signals]
        kind = "exponential " if isinstance(self.terms[0], ExponentialShadowing) else ""
        word = "lengths" if len(parts) > 1 else "length"
        text = " and ".join(part + end for part, end in zip(parts, ends, strict=True))
        return f"{kind}{word} {text}, noise {self.noise:.3g} of the signal's variance"

    @property
    def compiled_lengths(self) -> list[float] | None:
        """Lengths as compiled kernels have them, negative of Matern-1/2;
        None where they cannot answer.
        """
        signed = [term.compiled * float(term.length) for term in self.signals]
        return signed if all(signed) and len(signed) <= COMPILED else None

    @property
    def is_isotropic(self) -> bool:
        """Whether distances are all that counts, also where both ends move."""
        return all(term.by_distance for term in self.signals)

    def correlation(self, distance: Tensor) -> Tensor:
        """Return correlations at distances (...) [m]."""
        if len(self.signals) == 1:
            return self.signals[0].correlation(distance)
        first, *others = (term.share * term.correlation(distance) for term in self.signals)
        return sum(others, first)

    def correlations(self, a: Tensor, b: Tensor) -> Tensor:
        """Return correlations (..., n, m) of places (..., n, D) and (..., m, D) [m]."""
        if self.is_isotropic:
            return self.correlation(distances(a, b))
        first, *others = (term.covariance(a, b) for term in self.signals)
        return sum(others, first)

    def correlations_of(self, apart: Tensor) -> Tensor:
        """Return correlations (..., n, n) at distances [m], or at places (..., n, D)
        where more counts.
        """
        return self.correlation(apart) if self.is_isotropic else self.correlations(apart, apart)

    def gram(self, places: Tensor) -> Tensor:
        """Return correlations (n, n) with noise of places (n, D) [m]; times `amplitude`:
        covariances.
        """
        result = self.correlations(places, places)
        result.diagonal().add_(self.noise)
        return result

    def parameters(self) -> Tensor:
        """Return those of all signals, logarithms of shares relative to the last,
        that of the noise.
        """
        *signals, noise = (term.parameters() for term in self.terms)
        shares = torch.tensor(self.shares if len(signals) > 1 else [1.0], dtype=torch.float64).log()
        return torch.cat([*signals, shares[:-1] - shares[-1], noise])

    def bounds(self, distance: Tensor) -> list[tuple[float, float]]:
        """Return bounds of the parameters, in their order.

        Takes distances (...) [m] of the rows where terms depend on these alone,
        else their places (n, D) [m].

        >>> [round(low, 2) for low, _ in Kernel.from_length(1.0, 1.0).bounds(torch.tensor([10.0]))]
        [-4.61, -13.82]
        """
        distance = distance if self.is_isotropic else distances(distance, distance)
        *lengths, noise = (term.bounds(median_distance(distance)) for term in self.terms)
        shares = [(-SHARES, SHARES)] * (len(lengths) - 1)
        return [*chain(*lengths), *shares, *noise]

    def with_values(self, parameters: Tensor) -> Self:
        """Return the kernel of other parameters; numbers are tensors where gradients flow."""
        sizes, count = [len(term.parameters()) for term in self.terms], len(self.terms) - 1
        *numbers, logits, noise = parameters.split([*sizes[:-1], count - 1, sizes[-1]])
        signals = tuple(
            term.with_values(values) for term, values in zip(self.signals, numbers, strict=True)
        )
        if count > 1:
            # Of logits all shares lie between 0 and 1, whatever a step does.
            shares = torch.cat([logits, logits.new_zeros(1)]).softmax(0)
            signals = tuple(
                replace(signal, share=to_number(s))
                for signal, s in zip(signals, shares, strict=True)
            )
        return replace(self, terms=(*signals, self.terms[-1].with_values(noise)))


def to_number(value: Tensor) -> Tensor | float:
    """Return a tensor () as it is where gradients flow, else its number."""
    return value if value.requires_grad else float(value)
