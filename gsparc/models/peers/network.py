"""Scene description and base class of the peers' networks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsparc.data.schema import Batch, Site
from gsparc.ops import Pose
from gsparc.training.losses import channel_loss, spectrum_loss


@dataclass(frozen=True)
class Scene:
    """What a network may know of a site before it is trained.

    Attributes:
        site: the fixed facts.
        shape: of one target: (H, W), (antennas, subcarriers) or (1,).
        receiver: pose of the static receiver; None when it moves.
        transmitter: (3,) [m], the static transmitter; None when it moves.
        box: (2, 3) float32 [m], lower and upper corner of the moving end's training positions.
    """

    site: Site
    shape: tuple[int, ...]
    receiver: Pose | None
    transmitter: Tensor | None
    box: Tensor

    @property
    def reach(self) -> float:
        """Extent of the scene [m]: from the static end to the far side of the box."""
        low, high = self.box
        still = self.receiver.position if self.receiver is not None else self.transmitter
        middle = (low + high) / 2
        apart = 0.0 if still is None else float((still - middle).norm())
        return max(apart + float((high - low).norm()) / 2, 1.0)


class Network(nn.Module):
    """Positions in, targets out: called with tx (B, 3) [m] and one shared or B receiver poses."""

    scene: Scene
    count = 0  # Gaussians, or virtual transmitters
    ssim_weight = 0.2  # share of the loss of spectra

    def loss(self, batch: Batch, draw: torch.Generator) -> Tensor:
        """Training loss () of a batch; `draw` for whatever is drawn at random."""
        prediction = self(batch.tx, batch.rx)
        if prediction.is_complex():
            return channel_loss(prediction, batch.target, batch.mask).mean()
        if batch.mask is not None:
            prediction = torch.where(batch.mask, prediction, batch.target)
        return spectrum_loss(prediction, batch.target, self.ssim_weight).mean()

    @torch.no_grad()
    def answer(self, tx: Tensor, rx: Pose) -> Tensor:
        """The prediction at inference, which may keep state between calls."""
        return self(tx, rx)
