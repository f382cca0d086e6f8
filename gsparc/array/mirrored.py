"""Reflections of a moving transmitter at a static array: each is the transmitter seen from a mirrored array.

`h_m(x) = sum_i g_i exp(-j k |x - p_i - Q_i a_m|) / |x - p_i - Q_i a_m|` with Q_i orthogonal: one position,
one orientation and one gain give the phase, its slope over the elements and the moving direction of arrival
of a path for every x. Mirroring in a plane with normal n takes (p, Q) to (p', (1 - 2 n n^T) Q): the images of
Allen and Berkley (1979), taken of the receiving end.

A scatterer at p is another kind of source: two legs, `g exp(-j k (d1 + d2)) / (d1 d2)`, the second from p to
the true array, so that its direction of arrival stays where it is.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class MirroredArrays(nn.Module):
    """N mirrored arrays; all lengths and phases in float64.

    Args:
        array: (M, 3) [m] elements, receiver frame.
        wavelength: [m].
        positions: (N, 3) [m] p_i, the images of the array's origin.
        frames: (N, 3, 3) orthogonal Q_i, receiver frame to world; determinant -1 after an odd number of
            mirrors.
        gains: (N,) complex.
        scattering: (N,) bool, sources that are scatterers (their frames mean nothing); None when none is. The
            first source is the array itself.
    """

    array: Tensor
    frames: Tensor
    scattering: Tensor

    def __init__(
        self,
        array: Tensor,
        wavelength: float,
        positions: Tensor,
        frames: Tensor,
        gains: Tensor,
        scattering: Tensor | None = None,
    ) -> None:
        super().__init__()
        none = torch.zeros(len(positions), dtype=torch.bool)
        self.register_buffer("scattering", none if scattering is None else scattering)
        self.wavelength = wavelength
        self.register_buffer("array", array.double())
        self.register_buffer("frames", frames.double())
        self.positions = nn.Parameter(positions.double())
        self.turns = nn.Parameter(
            torch.zeros_like(self.positions)
        )  # rotation vectors [rad] before the frames
        self.gains = nn.Parameter(torch.view_as_real(gains.to(torch.complex128)).clone())

    def orthogonal(self) -> Tensor:
        """Q_i (N, 3, 3): the initial frames turned by the learned rotations; the parity never changes."""
        return rotation(self.turns) @ self.frames

    def paths(self, x: Tensor) -> Tensor:
        """Unit-gain vectors (B, N, M) complex128 of transmitters at (B, 3) [m]."""
        elements = self.positions[:, None] + self.array @ self.orthogonal().transpose(1, 2)
        seen = spherical(x.double(), elements, self.wavelength)
        if not self.scattering.any():
            return seen
        both = two_legs(x.double(), self.positions, elements[0], self.wavelength)
        return torch.where(self.scattering[:, None], both, seen)

    def arrival(self, x: Tensor) -> Tensor:
        """Directions of arrival (B, N, 3), unit vectors in the receiver's frame."""
        q = self.orthogonal()
        seen = ((x.double()[:, None] - self.positions)[:, :, None] @ q).squeeze(2)
        fixed = (self.positions - self.positions[0]) @ q[0]
        return nn.functional.normalize(torch.where(self.scattering[:, None], fixed, seen), dim=-1)

    def forward(self, x: Tensor) -> Tensor:
        """Array vectors h (B, M) complex128 at (B, 3) [m]."""
        return torch.einsum("bnm,n->bm", self.paths(x), torch.view_as_complex(self.gains))

    def contributions(self, x: Tensor) -> Tensor:
        """Share (N,) of each source in the sum of powers at (B, 3) [m]."""
        power = self.paths(x).abs().square().sum((0, 2)) * self.gains.square().sum(1)
        return power / power.sum().clamp_min(1e-30)

    def hold_first(self) -> None:
        """Drop the first source's slopes of place and turn: the array itself stands where it was measured."""
        for parameter in (self.positions, self.turns):
            if parameter.grad is not None:
                parameter.grad[0] = 0

    @torch.no_grad()
    def pruned(self, x: Tensor, least: float) -> MirroredArrays:
        """The sources that contribute at least the share `least` at x (n, 3) [m]; the first always stays."""
        keep = self.contributions(x) >= least
        keep[0] = True
        return MirroredArrays(
            self.array, self.wavelength, self.positions[keep], self.orthogonal()[keep],
            torch.view_as_complex(self.gains[keep].contiguous()), self.scattering[keep],
        )  # fmt: skip


def spherical(x: Tensor, elements: Tensor, wavelength: float) -> Tensor:
    """`exp(-j k r) / r` (B, N, M) between (B, 3) and (N, M, 3) [m]; float64, whole cycles taken off first."""
    distance = torch.linalg.vector_norm(x[:, None, None] - elements, dim=-1).clamp_min(1e-3)
    cycles = torch.remainder(distance / wavelength, 1.0)
    return torch.polar(1 / distance, -2 * math.pi * cycles)


def two_legs(x: Tensor, points: Tensor, elements: Tensor, wavelength: float) -> Tensor:
    """`exp(-j k (d1 + d2)) / (d1 d2)` (B, N, M): from (B, 3) by points (N, 3) to elements (M, 3) [m]."""
    before = spherical(x, points[:, None], wavelength)
    after = spherical(points, elements[None], wavelength)[:, 0]
    return before * after


def mirror(position: Tensor, frame: Tensor, image: Tensor) -> Tensor:
    """Frames (K, 3, 3) of an array at `position` (3,) with `frame` (3, 3), mirrored to `image` (K, 3) [m].

    The mirror is the plane halfway between the two.
    """
    normal = nn.functional.normalize(image - position, dim=-1)
    return frame - 2 * normal[:, :, None] * (normal @ frame)[:, None, :]


def rotation(turn: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) [rad]; smooth at 0."""
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
    return torch.linalg.matrix_exp(cross)
