"""A network in the style of FIRE: a variational autoencoder
from one antenna's uplink to its downlink.

After Liu et al., "FIRE: Enabling reciprocity for FDD MIMO systems", MobiCom 2021: the code
represents the paths, and the decoder evaluates them in the other band. Sizes and training are ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.query import Batch, Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.data.target import Kind
from gsparc.models.method import Prediction
from gsparc.models.peers.trained import KnownSite, Network, TrainedPeer, perceptron
from gsparc.models.uplink.interface import UplinkMethod, root_mean_power
from gsparc.training.context import FitContext, FitReport

HIDDEN, CODE = 256, 32  # units of each hidden layer, numbers of the code
DIVERGENCE = 1e-4  # weight of the code's divergence in the loss


class Coder(Network):
    """Complex (B, L) -> complex (B, K) through a Gaussian code, the same of all antennas."""

    def __init__(self, scene: KnownSite, settings: Fire) -> None:
        super().__init__(scene)
        assert scene.site.uplink_hz is not None
        self.antennas = torch.from_numpy(np.asarray(scene.site.antennas))
        # Of every number of the code a mean and the logarithm of its variance.
        self.encoder = perceptron(2 * len(scene.site.uplink_hz), 2 * CODE, HIDDEN, 2, nn.GELU)
        self.decoder = perceptron(CODE, 2 * scene.shape[1], HIDDEN, 2, nn.GELU)

    def downlink_and_divergence(
        self, uplink: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the downlink (B, K) and the code's divergence from a standard normal (B,)."""
        middle, log_variance = self.encoder(torch.view_as_real(uplink).flatten(1)).chunk(2, dim=1)
        code = middle if noise is None else middle + noise * (log_variance / 2).exp()
        # KL divergence of N(m, s^2) from N(0, 1) (Kingma and Welling 2014, appendix B).
        divergence = 0.5 * (middle.square() + log_variance.exp() - 1 - log_variance).sum(1)
        out = self.decoder(code)
        return torch.view_as_complex(out.view(len(out), -1, 2)), divergence

    def forward(self, query: Query) -> Tensor:
        """Return channels (B, A, K) from the query's uplink."""
        assert query.uplink is not None
        uplink, scale = self.unit_uplink_and_level(query.uplink)
        downlink, _ = self.downlink_and_divergence(uplink.flatten(0, 1))
        return downlink.view(*uplink.shape[:2], -1) * scale

    def unit_uplink_and_level(self, uplink: Tensor) -> tuple[Tensor, Tensor]:
        """Return uplinks (B, A, L) of antennas that answer, at unit power,
        and their level (B, 1, 1).
        """
        # Both bands lose alike along the path: the uplink's level carries over to the downlink.
        scale = root_mean_power(uplink)[:, None, None]
        return uplink[:, self.antennas] / scale, scale

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the mean squared error () of unit channels,
        and the code's divergence by its weight.
        """
        assert batch.uplink is not None
        uplink, scale = self.unit_uplink_and_level(batch.uplink)
        # As many antennas of snapshots as there are snapshots, whatever the array:
        # steps cost alike.
        pick = torch.randint(uplink.shape[0] * uplink.shape[1], (len(uplink),), generator=generator)
        # Snapshots have arbitrary phase: rotating both ends augments the data.
        angle = 2 * math.pi * torch.rand(len(uplink), 1, generator=generator)
        turn = torch.polar(torch.ones_like(angle), angle)
        noise = torch.randn(len(uplink), CODE, generator=generator)
        guess, divergence = self.downlink_and_divergence(uplink.flatten(0, 1)[pick] * turn, noise)
        missed = guess - (batch.target / scale).flatten(0, 1)[pick] * turn
        return missed.abs().square().mean() + DIVERGENCE * divergence.mean()


@dataclass(eq=False, kw_only=True)
class Fire(UplinkMethod, TrainedPeer):
    """One network for all antennas, each snapshot at unit uplink power;
    settings as of `TrainedPeer`.
    """

    usual_steps: ClassVar[dict[Kind, int]] = {"csi": 4_800}
    makes = Coder
    name: str = "fire"
    batch_size: int = 256
    rate: float = 1e-3

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """See `TrainedPeer.fit`; on all antennas."""
        self._require_uplink(data)
        return super().fit(data, fold, context)

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; of the uplink alone."""
        self.query_uplinks(query)
        return super().predict(query)
