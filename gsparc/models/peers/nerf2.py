"""NeRF2: two networks, marched along a ray per pixel.

X. Zhao, Z. An, Q. Pan, L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", MobiCom 2023;
sizes and march also by the authors' program.

Kept: an attenuation network (place -> attenuation, turn of the phase and a feature) whose input is
given again half-way, a signal network of two layers (feature, direction, transmitter -> amplitude
and phase), phases bounded to a turn, 1/d, no factor of opacity, the coherent sum along every ray,
the magnitude of it, squared error on rays drawn at random. Left out: the branches for RSSI and MIMO
channels, weight decay, octaves that begin at 2 pi metres (ours begin at the extent of the scene).
The published sizes are `paper=nerf2`: minutes an image on a CPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import torch
from torch import Tensor, nn

from gsparc.data.query import Batch, Query
from gsparc.data.target import Kind
from gsparc.field.encoding import EncodingSettings, PositionEncoding
from gsparc.models.peers.trained import (
    DIRECTIONS,
    KnownSite,
    Network,
    TrainedPeer,
    perceptron,
    smooth_root,
)
from gsparc.ops import Pose

REFERENCE = 0.025  # [m] at which a signal has unit gain: 1/d without its constant
POINTS = 2**16  # evaluated at a time at inference


class MarchedField(Network):
    """The two networks and the march."""

    directions: Tensor

    def __init__(self, scene: KnownSite, settings: NeRF2) -> None:
        super().__init__(scene)
        assert scene.site.grid is not None
        self.samples, self.rays = settings.samples, settings.rays
        self.far = 1.5 * scene.reach if settings.far_m is None else settings.far_m
        centre = scene.box.mean(0) if scene.receiver is None else scene.receiver.position
        around = torch.stack([centre - self.far, centre + self.far])
        octaves, width, half = settings.octaves, settings.width, settings.depth // 2
        self.place = PositionEncoding(EncodingSettings("fourier", octaves), around)
        self.query = PositionEncoding(EncodingSettings("fourier", octaves), scene.box)
        self.heading = PositionEncoding(
            EncodingSettings("fourier", settings.view_octaves), DIRECTIONS
        )
        self.early = perceptron(self.place.width, width, width, half)
        self.late = perceptron(
            self.place.width + width, 2 + width, width, settings.depth - half - 1
        )
        # The first layer is linear: what all samples of a ray share is added, not repeated.
        self.by_feature = nn.Linear(width, width)
        self.by_ray = nn.Linear(self.heading.width + self.query.width, width)
        self.signal = perceptron(width, 2, width // 2, 1)
        self.register_buffer("directions", scene.site.grid.directions(torch.float32).flatten(0, -2))

    def march(self, origin: Tensor, heading: Tensor, query: Tensor) -> Tensor:
        """Return magnitudes (R,) seen from origin (R, 3) [m] along unit vectors (R, 3);
        query (R, 3) [m].
        """
        step = self.far / self.samples
        depth = step * torch.arange(self.samples)
        places = origin[:, None] + depth[:, None] * heading[:, None]
        place = self.place(places)
        out = self.late(torch.cat([place, self.early(place).relu()], -1))
        shared = self.by_ray(torch.cat([self.heading(heading), self.query(query)], -1))
        signal = self.signal((self.by_feature(out[..., 2:]) + shared[:, None]).relu())
        raw = torch.stack([out[..., :2], signal])  # of attenuation and signal: size and phase
        size, phase = (
            nn.functional.leaky_relu(raw[..., 0]).abs(),
            2 * math.pi * torch.sigmoid(raw[..., 1]),
        )
        thick, turn = step * size[0], step * phase[0]
        gain = (thick - thick.cumsum(1)).exp() * size[1] * REFERENCE / (depth + step)
        wave = torch.polar(gain, turn.cumsum(1) - turn + phase[1])
        return smooth_root(wave.sum(1).abs().square())

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the mean squared error () of rays drawn at random."""
        sample = torch.randint(len(batch), (self.rays,), generator=generator)
        pixel = torch.randint(len(self.directions), (self.rays,), generator=generator)
        origin, heading = self._origins_and_directions(batch.rx, sample, pixel)
        seen = self.march(origin, heading, self.scene.site.moving(batch.tx, batch.rx)[sample])
        error = (seen - batch.target.flatten(1)[sample, pixel]).square()
        if batch.mask is not None:
            error = error * batch.mask.flatten(1)[sample, pixel]
        return error.mean()

    def forward(self, query: Query) -> Tensor:
        """Return spectra (B, H, W), every ray of them."""
        rx, pixels = query.rx, torch.arange(len(self.directions))
        moving = self.scene.site.moving(query.tx, rx)
        parts = []
        for sample, some in product(
            range(len(query)), pixels.split(max(POINTS // self.samples, 1))
        ):
            which = torch.full_like(some, sample)
            parts.append(self.march(*self._origins_and_directions(rx, which, some), moving[which]))
        return torch.cat(parts).view(len(query), *self.scene.shape)

    def _origins_and_directions(
        self, rx: Pose, sample: Tensor, pixel: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Origins and world directions (R, 3) of the pixels of samples."""
        local = self.directions[pixel]
        if not rx.batched:
            return rx.position.expand_as(local), local @ rx.rotation.T
        return rx.position[sample], (rx.rotation[sample] @ local.unsqueeze(-1)).squeeze(-1)


@dataclass(eq=False, kw_only=True)
class NeRF2(TrainedPeer):
    """Spectra.

    Args:
        width, depth: of the attenuation network; the signal network's two layers have `width` and
            half of it.
        samples: points per ray.
        rays: pixels drawn per step, spread over the batch.
        octaves, view_octaves: of the Fourier features of places and transmitters, and of
            directions.
        far_m: where rays end [m]; None: one and a half times the extent of the scene.
        others: see `TrainedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"spectrum": 462}
    makes = MarchedField
    name: str = "nerf2"
    width: int = 64
    depth: int = 4
    samples: int = 32
    rays: int = 1024
    octaves: int = 6
    view_octaves: int = 3
    far_m: float | None = None
