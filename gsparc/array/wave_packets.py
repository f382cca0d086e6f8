"""A field of wave packets in the transmitter's position: the query model distilled from the vector GP.

`h(x) = sum_i G_i(x) (a_i cos w_i.x + b_i sin w_i.x)` with Gaussians G_i and complex a_i, b_i per element: a
packet is a departing plane wave within the region where it is visible and coherent. Away from all packets
every feature vanishes and the unknown share is 1. Centres, widths and wave vectors are drawn once; gains come
from the teacher by ridge regression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dsyrk
from torch import Tensor, nn

from gsparc.array.vector_gp import VectorGP

MIN_PACKETS, MAX_PACKETS = 256, 2048  # of the default count: query time grows with it
RIDGE = 1e-6  # relative to a feature's mean square


@dataclass(frozen=True)
class PacketSettings:
    """Number and shape of the packets, and where the teacher is evaluated.

    Lengths are in units of the teacher's length, at most a wavelength.

    Attributes:
        count: number of packets; None takes 8 per sample, at least 256 and at most 2,048.
        widths: standard deviations of the Gaussians, in equal numbers.
        jitter: distance of centres from samples, in widths.
        pitch: wave vectors are of size `pitch / width`.
        samples: evaluations of the teacher beside its own samples; `near` and `far` are their least and
            largest distance from one.
        ridge: relative to a feature's mean square.
    """

    count: int | None = None
    widths: tuple[float, ...] = (0.2, 0.4, 0.8)
    jitter: float = 0.3
    pitch: float = 1.0
    samples: int = 5000
    near: float = 0.02
    far: float = 3.0
    ridge: float = RIDGE


class WavePackets(nn.Module):
    """Packets and their gains.

    Args:
        centres: (N, 3) [m].
        widths: (N,) [m].
        waves: (N, 3) [rad/m].
        origin: (3,) [m], subtracted from positions first.
        elements: M.
    """

    # Positions and `form` are float64: in a site of 10^4 widths (millimetre waves) these squares are 1e8, and
    # what is left of them at a packet is of order 1.

    form: Tensor
    origin: Tensor
    bias: Tensor

    def __init__(self, centres: Tensor, widths: Tensor, waves: Tensor, origin: Tensor, elements: int) -> None:
        super().__init__()
        self.elements = elements
        c, w, s = centres.double() - origin.double(), waves.double(), widths.double()
        # Exponent and phase are linear in (x, x^2, 1): one small product gives both.
        curve = (-0.5 / s**2).expand(3, -1)
        exponent = torch.cat([(c / s[:, None] ** 2).T, curve, -0.5 * (c**2).sum(1)[None] / s**2])
        phase = torch.cat([w.T, torch.zeros(3, len(w)), -(c * w).sum(1)[None]])
        self.register_buffer("form", torch.cat([exponent, phase], 1).contiguous())
        self.register_buffer("origin", origin.double())
        self.gains = nn.Parameter(torch.zeros(2 * len(centres), 2 * elements + 2))
        self.register_buffer("bias", torch.tensor([0.0] * (2 * elements) + [1.0, 0.0]))

    def features(self, x: Tensor) -> Tensor:
        """(B, 2 N) of positions (B, 3) [m], in their precision."""
        away = x.double() - self.origin
        lifted = torch.cat([away, away * away, torch.ones_like(away[:, :1])], 1)
        exponent, phase = (lifted @ self.form).to(x.dtype).chunk(2, 1)
        window = exponent.clamp(max=0).exp()
        return torch.cat([window * phase.cos(), window * phase.sin()], 1)

    def forward(self, x: Tensor) -> Tensor:
        """Array vectors and, as one more element, the unknown share of the amplitude: (B, M + 1) complex.

        The share is real, in [0, 1], and 1 away from all packets.
        """
        out = torch.addmm(self.bias, self.features(x), self.gains)
        out[:, -2:].clamp_(0, 1)
        return torch.view_as_complex(out.view(len(x), -1, 2))

    @torch.no_grad()
    def strongest(self, share: float, contribution: Tensor, places: Tensor) -> WavePackets:
        """The `share` of the packets that contribute (N,) most, fitted to all around places (n, 3) [m]."""
        total = len(contribution)
        count = max(1, math.ceil(share * total))
        kept = contribution.topk(count).indices.sort().values
        blank = (torch.zeros(count, 3), torch.ones(count), torch.zeros(count, 3), self.origin)
        few = WavePackets(*blank, elements=self.elements).requires_grad_(False)
        both = torch.cat([kept, kept + total])
        few.form.copy_(self.form[:, both])
        widths = self.form[3, :total].neg().mul(2).rsqrt()  # of the window exp(-x^2 / 2 s^2)
        draws = torch.Generator().manual_seed(0)
        spread = widths.median() * torch.randn(8, *places.shape, generator=draws)
        queries = torch.cat([places, (places + spread / 2).flatten(0, 1)])
        features = few.features(queries).double()
        wanted = (self.features(queries) @ self.gains).double()
        gram = features.mT @ features
        gram.diagonal().add_(RIDGE * gram.diagonal().mean())
        few.gains.copy_(torch.linalg.solve(gram, features.mT @ wanted).float())
        few.bias.copy_(self.bias)
        return few


def student_t(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) draws from the spectral density of Matern-3/2 of length 1: Student's t, 3 degrees."""
    return rng.standard_normal((count, 3)) / np.sqrt(rng.chisquare(3, (count, 1)) / 3)


def distil(teacher: VectorGP, settings: PacketSettings, wavelength: float, seed: int) -> WavePackets:
    """Packets fitted to the teacher at and around its samples, by ridge regression.

    Widths scale with the teacher's correlation length, at most one `wavelength` [m].
    """
    rng = np.random.default_rng([seed, 7])
    places, length = teacher.positions, min(teacher.kernel.length, wavelength)
    n, m = teacher.vectors.shape
    count = settings.count or int(np.clip(8 * n, MIN_PACKETS, MAX_PACKETS))
    widths = length * np.resize(settings.widths, count)
    centres = places[rng.integers(0, n, count)]
    centres = centres + settings.jitter * widths[:, None] * rng.standard_normal((count, 3))
    waves = settings.pitch / widths[:, None] * student_t(count, rng)
    c, s, w, origin = (torch.from_numpy(part) for part in (centres, widths, waves, places.mean(0)))
    field = WavePackets(c, s, w, origin, m)
    reach = np.exp(rng.uniform(np.log(settings.near), np.log(settings.far), (settings.samples, 1))) * length
    around = places[rng.integers(0, n, settings.samples)] + reach * rng.standard_normal((settings.samples, 3))
    queries = np.concatenate([places, around])
    mean, unknown = (
        np.concatenate(p) for p in zip(teacher.at_samples(), teacher.posterior(around), strict=True)
    )
    # Pairs of real and imaginary parts; the unknown share is learned as its distance from 1.
    wanted = np.concatenate([mean, np.sqrt(unknown)[:, None] - 1], 1).view(np.float64)
    weight = np.where(np.arange(len(queries)) < n, 2.0**0.5, 1.0)[:, None]  # samples count twice
    with torch.no_grad():
        features = weight * field.features(torch.from_numpy(queries)).numpy()
        gram = dsyrk(1.0, features.T, lower=1)  # one triangle: half the work
        gram[np.diag_indices_from(gram)] += settings.ridge * np.trace(gram) / len(gram)
        gains = cho_solve(cho_factor(gram, lower=True, overwrite_a=True), features.T @ (weight * wanted))
        field.gains.copy_(torch.from_numpy(gains))
    return field
