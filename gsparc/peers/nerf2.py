"""NeRF2: two networks, marched along a ray per pixel.

X. Zhao, Z. An, Q. Pan, L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", MobiCom 2023.

Kept: an attenuation network (place -> complex attenuation and a feature), a radiance network (feature,
direction, transmitter -> complex signal), the coherent sum along every ray, the magnitude of it, squared
error on rays drawn at random. Left out: the branches for RSSI and MIMO channels. The published size (two
networks of 8 x 256, 64 samples a ray) is `width=256 depth=8 samples=64`: minutes an image on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import torch
from torch import Tensor, nn

from gsparc.data.schema import Batch, Kind
from gsparc.field.encoding import EncodingSettings, PositionEncoding
from gsparc.ops import Pose
from gsparc.peers.deformation import perceptron
from gsparc.peers.network import Network, Scene
from gsparc.peers.trained import TrainedPeer

NEAR = 0.3  # [m] from the receiver, where rays begin
POINTS = 2**16  # evaluated at a time at inference
TINY = 1e-8  # under the root of a magnitude


@dataclass(eq=False, kw_only=True)
class NeRF2(TrainedPeer):
    """Spectra.

    Args:
        width, depth: hidden layers of the attenuation network; the radiance network has half as many.
        samples: points per ray.
        rays: pixels drawn per step, spread over the batch.
        octaves: of the Fourier features of places and transmitters.
        others: see `TrainedPeer`.
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("spectrum",)
    name: str = "nerf2"
    width: int = 64
    depth: int = 4
    samples: int = 32
    rays: int = 1024
    octaves: int = 6

    def build(self, scene: Scene, found: dict[str, Tensor]) -> Network:
        """See `TrainedPeer.build`."""
        return MarchedField(scene, self.width, self.depth, self.samples, self.rays, self.octaves)


class MarchedField(Network):
    """The two networks and the march."""

    directions: Tensor

    def __init__(self, scene: Scene, width: int, depth: int, samples: int, rays: int, octaves: int) -> None:
        super().__init__()
        assert scene.site.grid is not None
        self.scene, self.samples, self.rays = scene, samples, rays
        self.far = 1.5 * scene.reach
        centre = scene.box.mean(0) if scene.receiver is None else scene.receiver.position
        around = torch.stack([centre - self.far, centre + self.far])
        self.place = PositionEncoding(EncodingSettings("fourier", octaves), around)
        self.query = PositionEncoding(EncodingSettings("fourier", octaves), scene.box)
        self.heading = PositionEncoding(EncodingSettings("fourier", 3), torch.tensor([[-1.0] * 3, [1.0] * 3]))
        self.attenuation = perceptron(self.place.width, 2 + width, width, depth)
        # The first layer is linear: what all samples of a ray share is added, not repeated.
        self.by_feature = nn.Linear(width, width)
        self.by_ray = nn.Linear(self.heading.width + self.query.width, width)
        self.radiance = perceptron(width, 2, width, max(depth // 2 - 1, 0))
        self.register_buffer("directions", scene.site.grid.directions(torch.float32).reshape(-1, 3))

    def march(self, origin: Tensor, heading: Tensor, query: Tensor, jitter: Tensor | None) -> Tensor:
        """Magnitude (R,) seen from origin (R, 3) [m] along unit vectors (R, 3); query (R, 3) [m].

        `jitter` (R, S) in [0, 1) places the samples within their intervals; None takes the middles.
        """
        step = (self.far - NEAR) / self.samples
        steps = torch.arange(self.samples) + (0.5 if jitter is None else jitter)
        depth = (NEAR + step * steps).expand(len(origin), -1)
        places = origin[:, None] + depth[..., None] * heading[:, None]
        out = self.attenuation(self.place(places.reshape(-1, 3))).view(len(origin), self.samples, -1)
        density, turn, feature = nn.functional.softplus(out[..., 0]), out[..., 1], out[..., 2:]
        shared = self.by_ray(torch.cat([self.heading(heading), self.query(query)], -1))
        hidden = (self.by_feature(feature.relu()) + shared[:, None]).relu()
        signal = torch.view_as_complex(self.radiance(hidden))
        thick = density * step
        passed = thick.cumsum(1) - thick
        arrived = torch.polar((-passed).exp() * -torch.expm1(-thick), turn.cumsum(1) - turn)
        return ((arrived * signal).sum(1).abs().square() + TINY).sqrt()

    def loss(self, batch: Batch, draw: torch.Generator) -> Tensor:
        """Mean squared error () of rays drawn at random."""
        sample = torch.randint(len(batch), (self.rays,), generator=draw)
        pixel = torch.randint(len(self.directions), (self.rays,), generator=draw)
        origin, heading = self._rays(batch.rx, sample, pixel)
        jitter = torch.rand(self.rays, self.samples, generator=draw)
        seen = self.march(origin, heading, self.scene.site.moving(batch.tx, batch.rx)[sample], jitter)
        error = (seen - batch.target.flatten(1)[sample, pixel]).square()
        if batch.mask is not None:
            error = error * batch.mask.flatten(1)[sample, pixel]
        return error.mean()

    def forward(self, tx: Tensor, rx: Pose) -> Tensor:
        """Spectra (B, H, W), every ray of them."""
        moving, pixels = self.scene.site.moving(tx, rx), torch.arange(len(self.directions))
        parts = []
        for sample, some in product(range(len(tx)), pixels.split(max(POINTS // self.samples, 1))):
            which = torch.full_like(some, sample)
            parts.append(self.march(*self._rays(rx, which, some), moving[which], None))
        return torch.cat(parts).view(len(tx), *self.scene.shape)

    def _rays(self, rx: Pose, sample: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and world directions (R, 3) of the pixels of samples."""
        local = self.directions[pixel]
        if not rx.batched:
            return rx.position.expand(len(pixel), 3), local @ rx.rotation.T
        return rx.position[sample], (rx.rotation[sample] @ local.unsqueeze(-1)).squeeze(-1)
