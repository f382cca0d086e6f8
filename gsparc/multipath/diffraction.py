"""Diffracting edges: the diffraction point moves along a straight edge with the receiver.

The ray of J. B. Keller (1962) reaches a receiver after s' + s metres, both legs measured along the straight
line that is left when the half planes through transmitter and receiver are unfolded about the edge, with
amplitude `1 / sqrt(s s' (s + s'))`. The wave looks as if it came from a point that turns about the edge with
the receiver, so that no fixed source can stand for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsparc.multipath.backprojection import ascend, score_waves
from gsparc.multipath.gp_likelihood import CircularFactor, Posterior, Scene
from gsparc.multipath.refine import Late, never, refine
from gsparc.multipath.rows import Rows
from gsparc.physics.waves import NEAR_M, reduced_phase

MOST = 4  # edges
LEAST_NATS = 20.0  # gain of log likelihood: an edge has four parameters and a gain
CANDIDATES, BLOCK = 40_000, 512  # drawn in the box, and how many are scored at a time
TILT = 0.03  # [rad], standard deviation of a candidate's axis about x, y or z
POLISHED, STEPS, STEP_M = 48, 60, 0.02  # best candidates; steps of ascent, and their size [m, rad]
REFINE_STEPS = 12  # of the sources after each edge


@dataclass(frozen=True)
class Edges:
    """K edges and the complex gain each has for R outputs.

    Attributes:
        point: (K, 3) float64 [m], any point of each.
        axis: (K, 3) float64 unit vectors along them.
        gain: (K, R) complex64.
    """

    point: Tensor
    axis: Tensor
    gain: Tensor

    @staticmethod
    def none() -> Edges:
        """No edge."""
        nothing = torch.zeros(0, 3, dtype=torch.float64)
        return Edges(nothing, nothing, torch.zeros(0, 1, dtype=torch.complex64))

    def __len__(self) -> int:
        return len(self.point)

    def field(self, places: Tensor, frequency_hz: Tensor, transmitter: Tensor) -> Tensor:
        """Field of the edges (n, R) complex64 at places (n, 3) [m] and frequencies (n,) [Hz].

        `transmitter` is (3,), or (n, 3) for each place.
        """
        if not len(self):
            return torch.zeros(len(places), 1, dtype=torch.complex64)
        return edge_wave(places, self.point, self.axis, transmitter, frequency_hz) @ self.gain

    def over_band(self, places: Tensor, tones_hz: Tensor, transmitter: Tensor) -> Tensor:
        """The same at every tone (F,): (n, R, F)."""
        each = [self.field(places, tone.expand(len(places)), transmitter) for tone in tones_hz]
        return torch.stack(each, -1)


def diffracted(places: Tensor, edges: Edges, transmitter: Tensor) -> tuple[Tensor, Tensor]:
    """Ranges (n, K) float64 [m] of the rays by way of the edges, and where they meet them (n, K, 3) [m]."""
    length, across_rx, across, along_rx, along_tx = _unfolded(places, edges.point, edges.axis, transmitter)
    met = along_rx + (along_tx - along_rx) * across_rx / across.clamp_min(NEAR_M)
    return length, edges.point + met[..., None] * edges.axis


def _unfolded(places: Tensor, point: Tensor, axis: Tensor, transmitter: Tensor) -> tuple[Tensor, ...]:
    """Length of the straight line, distance of the place and of both ends from the edge, and along it."""
    along_rx, across_rx = _cylindrical(places, point, axis)
    along_tx, across_tx = _cylindrical(transmitter.reshape(-1, 3), point, axis)
    across = across_rx + across_tx
    length = ((along_rx - along_tx).square() + across.square() + NEAR_M**2).sqrt()
    return length, across_rx, across, along_rx, along_tx


def _cylindrical(places: Tensor, points: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Cylindrical coordinates (n, K) [m] of places (n, 3) about each edge: along it, and distance from it."""
    offset = places.double()[:, None, :] - points.double()[None]
    along = (offset * axes).sum(-1)
    return along, (offset - along[..., None] * axes).square().sum(-1).add(NEAR_M**2).sqrt()


def edge_wave(
    places: Tensor, point: Tensor, axis: Tensor, transmitter: Tensor, frequency_hz: Tensor
) -> Tensor:
    """Unit-gain diffracted waves (n, K) complex64; the range is reduced in float64.

    Args:
        places: (n, 3) float64 [m].
        point, axis: (K, 3) float64 of the edges.
        transmitter: (3,) float64 [m], or (n, 3) for each place.
        frequency_hz: (n,) float64 [Hz].
    """
    length, across_rx, across = _unfolded(places, point, axis, transmitter)[:3]
    after = length * across_rx / across.clamp_min(NEAR_M)
    spread = (after.clamp_min(NEAR_M) * (length - after).clamp_min(NEAR_M) * length).sqrt()
    return torch.polar((1 / spread).float(), reduced_phase(length, frequency_hz[:, None]))


def propose(
    rows: Rows, factor: CircularFactor, transmitter: Tensor, box: Tensor, generator: torch.Generator,
    late: Late = never,
) -> tuple[Tensor, Tensor] | None:  # fmt: skip
    """Point and axis (3,) of the edge of largest gain given the sources of `factor`, or None.

    Args:
        rows: measurements.
        factor: of the covariance of the sources found so far.
        transmitter: (3,) float64 [m].
        box: (2, 3) float64 [m] where edges may pass.
        generator: of the candidates.
        late: asked between steps; there is none when it says so.
    """

    def waves(point: Tensor, axis: Tensor) -> Tensor:
        static = rows.static_end_of_each(transmitter)
        return edge_wave(rows.position, point, axis, static, rows.frequency)

    def scores(point: Tensor, axis: Tensor) -> Tensor:
        return score_waves(waves(point, normalize(axis, dim=1)), factor)[0]

    drawn = torch.rand(CANDIDATES, 3, generator=generator, dtype=torch.float64)
    point = box[0] + (box[1] - box[0]) * drawn
    axis = torch.eye(3, dtype=torch.float64)[torch.arange(len(point)) % 3]
    axis = axis + TILT * torch.randn(axis.shape, generator=generator, dtype=torch.float64)
    axis = normalize(axis, dim=1)
    arriving = (waves(*part) for part in zip(point.split(BLOCK), axis.split(BLOCK), strict=True))
    # `|a^H K^-1 y|^2 / |a|^2`
    rough = []
    for a in arriving:
        if late():
            return None
        rough.append((a.mH @ factor.alpha).abs().square().sum(1) / a.abs().square().sum(0))
    top = torch.cat(rough).topk(POLISHED).indices
    rates = [STEP_M * 0.5 * (1 + math.cos(math.pi * step / STEPS)) for step in range(STEPS)]
    point, axis = ascend([point[top], axis[top]], scores, rates)
    axis = normalize(axis, dim=1)
    gained = score_waves(waves(point, axis), factor)[0]
    best = int(gained.argmax())
    # A free complex gain on pure noise gains one nat.
    if float(gained[best] - gained[best].log() - 1) < LEAST_NATS:
        return None
    return point[best], axis[best]


def find_edges(
    rows: Rows, scene: Scene, box: Tensor, generator: torch.Generator, noise_floor: float, late: Late = never
) -> Edges:
    """Edges one by one, as long as the marginal likelihood accepts another; sources are refined in between.

    Args:
        rows: a few hundred.
        scene: sources found so far.
        box: (2, 3) float64 [m] where edges may pass.
        generator: of the candidates.
        noise_floor: known variance of the noise, in units of the rows' power.
        late: asked before each, and before every step of refining; no more are looked for when it says so.
    """
    edges, residual = Edges.none(), rows
    while len(edges) < MOST and not late():
        factor = Posterior(residual, scene, noise_floor).factor
        found = propose(residual, factor, scene.transmitter, box, generator, late)
        if found is None:
            break
        point, axis = (torch.cat([a, b[None]]) for a, b in zip((edges.point, edges.axis), found, strict=True))
        edges = fit_edge_gains(rows, point, axis, scene, noise_floor)
        residual = subtract_edges(rows, edges, scene.transmitter)
        scene = refine(residual, scene, REFINE_STEPS, noise_floor=noise_floor, late=late)
    return edges


def subtract_edges(rows: Rows, edges: Edges, transmitter: Tensor) -> Rows:
    """The rows minus the field of the edges."""
    static = rows.static_end_of_each(transmitter)
    return replace(rows, target=rows.target - edges.field(rows.position, rows.frequency, static))


def fit_edge_gains(rows: Rows, point: Tensor, axis: Tensor, scene: Scene, noise_floor: float) -> Edges:
    """Gains by generalised least squares beside the scene's sources: `(W^H K^-1 W)^-1 W^H K^-1 y`."""
    factor = Posterior(rows, scene, noise_floor).factor
    static = rows.static_end_of_each(scene.transmitter)
    waves = edge_wave(rows.position, point, axis, static, rows.frequency)
    white = factor.root @ waves
    gram = white.mH @ white
    gram.diagonal().add_(1e-6 * gram.diagonal().real.mean())
    return Edges(point, axis, torch.linalg.solve(gram, waves.mH @ factor.alpha))
