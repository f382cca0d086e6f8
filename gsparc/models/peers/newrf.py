"""NeWRF: rays along the directions of arrival only, marched for virtual transmitters.

H. Lu, C. Vattheuer, B. Mirzasoleiman, O. Abari, "NeWRF: A Deep Learning Framework for Wireless
Radiation Field Reconstruction and Channel Prediction", ICML 2024.

Kept: training rays along measured directions of arrival, a network of place and direction that says
where on the ray a virtual transmitter stands and what it sends, amplitude 1/d and the carrier's
phase over the marched distance; at a query the directions are *searched* (rays of training
receivers are triangulated, the nearest receivers vote which of the virtual transmitters are seen).
Left out: the network that predicts how many paths a query has (what at least half of the neighbours
see is taken); a density per metre (ours is an opacity per sample, since half of the samples lie
within 10 cm of where the intersection found something, in place of hierarchical resampling), four
octaves of directions (two), further rays, noise on directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gsparc.data.query import Batch, Query
from gsparc.data.schema import Measurements
from gsparc.data.target import Kind
from gsparc.field.encoding import EncodingSettings, PositionEncoding
from gsparc.models.directional.triangulation import Rays, triangulate
from gsparc.models.peers.trained import DIRECTIONS, KnownSite, Network, TrainedPeer, perceptron

NEAR = 0.1  # [m] from the receiver, where rays begin
AROUND = 0.1  # [m], half the interval of the fine samples
LEAST = 5  # receivers of a virtual transmitter: rays of fewer meet by chance


class DirectedRays(Network):
    """The network and the march."""

    def __init__(self, scene: KnownSite, settings: NeWRF) -> None:
        precomputed = settings.precomputed
        super().__init__(scene, len(precomputed["virtual"]))
        assert scene.site.wavelength is not None
        self.precomputed = precomputed
        self.samples, self.neighbours = (
            settings.samples,
            min(settings.neighbours, len(precomputed["places"])),
        )
        self.wavenumber = 2 * math.pi / scene.site.wavelength
        reach = (precomputed["virtual"][:, None] - precomputed["places"][None]).norm(dim=-1)
        self.far = float(torch.quantile(reach[precomputed["votes"].T > 0], 0.99)) + AROUND
        around = torch.stack([scene.box[0] - self.far, scene.box[1] + self.far])
        self.place = PositionEncoding(EncodingSettings("fourier", settings.octaves), around)
        self.heading = PositionEncoding(EncodingSettings("fourier", 2), DIRECTIONS)
        inputs = self.place.width + self.heading.width
        self.network = perceptron(inputs, 3, settings.width, settings.depth)

    def transmitters_and_likely(self, places: Tensor, skip_self: bool) -> tuple[Tensor, Tensor]:
        """Return virtual transmitters (B, P, 3) [m] likely seen from places (B, 3),
        and which are (B, P).

        At least half of the nearest training receivers see them. Training receivers (`skip_self`)
        see what they were measured to see.
        """
        distance = torch.cdist(places, self.precomputed["places"])
        near = distance.topk(1 if skip_self else self.neighbours, largest=False).indices
        share = (self.precomputed["votes"] > 0)[near].float().mean(1)
        best = share.topk(max(int((share >= 0.5).sum(1).max()), 1), dim=1)
        return self.precomputed["virtual"][best.indices], best.values >= 0.5

    def march(
        self, places: Tensor, goals: Tensor, likely: Tensor, rng: torch.Generator | None
    ) -> Tensor:
        """Return channels (B,) of rays from places (B, 3) to goals (B, P, 3) [m],
        those likely (B, P).
        """
        towards = goals - places[:, None]
        distance = towards.norm(dim=-1, keepdim=True).clamp_min(NEAR)
        heading = towards / distance
        half = self.samples // 2
        shape = (*heading.shape[:2], half)
        jitter = (
            torch.full((2, *shape), 0.5) if rng is None else torch.rand((2, *shape), generator=rng)
        )
        steps = torch.arange(half)
        coarse = NEAR + (self.far - NEAR) * (steps + jitter[0]) / half
        fine = (distance - AROUND + 2 * AROUND * (steps + jitter[1]) / half).clamp_min(NEAR / 2)
        depth = torch.cat([coarse, fine], -1).sort(-1).values
        points = places[:, None, None] + depth[..., None] * heading[:, :, None]
        turn = self.heading(heading)[:, :, None].expand(-1, -1, self.samples, -1)
        out = self.network(torch.cat([self.place(points), turn], -1))
        # Before training the samples of a ray let 1/e through: what stands at its end can be seen.
        opacity = out[..., 2] - math.log(self.samples)
        clear = F.logsigmoid(-opacity)  # finite also where the sigmoid rounds to 1
        weight = (clear.cumsum(-1) - clear).exp() * torch.sigmoid(opacity)
        gain = torch.view_as_complex(out[..., :2].contiguous())
        wave = torch.polar(weight / depth, -self.wavenumber * depth)
        return ((gain * wave).sum(-1) * likely).sum(-1)

    def forward(self, query: Query) -> Tensor:
        """Return channels (B, 1, 1) at searched directions."""
        places = torch.atleast_2d(query.rx.position)
        return self.march(places, *self.transmitters_and_likely(places, False), None).view(-1, 1, 1)

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the mean squared error along measured directions."""
        places = torch.atleast_2d(batch.rx.position)
        seen = self.march(places, *self.transmitters_and_likely(places, True), generator).view(
            -1, 1, 1
        )
        return (seen - batch.target).abs().square().mean()


@dataclass(eq=False, kw_only=True)
class NeWRF(TrainedPeer):
    """Channels of one antenna and one tone, with directions of arrival.

    Args:
        width, depth: of the network.
        octaves: of its Fourier features of places.
        samples: points per ray, half of them fine.
        neighbours: training receivers that vote at a query.
        others: see `TrainedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"csi": 659}
    makes = DirectedRays
    name: str = "newrf"
    width: int = 128
    depth: int = 4
    octaves: int = 8
    samples: int = 64
    neighbours: int = 6

    def precompute(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Return virtual transmitters, and which of them every training receiver sees.

        Raises:
            ValueError: no directions, no carrier, more than one antenna or tone, or a moving
                transmitter.
        """
        if data.directions is None:
            raise ValueError(f"{self.name}: needs directions of arrival; this dataset has none")
        if data.site.wavelength is None or data.site.static_end != "tx" or data.target[0].size != 1:
            raise ValueError(
                f"{self.name}: needs a moving receiver with one antenna, one tone and a known "
                "carrier"
            )
        places = data.rx_position[rows].astype(np.float64)
        towards = [(data.directions[i] @ data.rx_rotation[i].T).astype(np.float64) for i in rows]
        rays = Rays.from_receivers(places, towards)
        meetings = triangulate(rays, self.seed)
        votes = meetings.seen_points(rays)
        # Where none has as many, those of the most.
        virtual = votes.sum(0) >= min(LEAST, votes.sum(0).max(initial=0))
        if not virtual.any():
            raise ValueError(f"{self.name}: the directions of arrival meet nowhere")
        found = {"places": places, "virtual": meetings.points[virtual], "votes": votes[:, virtual]}
        return {name: torch.from_numpy(part).float() for name, part in found.items()}
