"""An autoencoder whose code is a position: similar uplinks are close, and codes fill their space."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

CODE = 3


@dataclass(frozen=True)
class EncoderSettings:
    """Shape and training of the encoder.

    Attributes:
        hidden: units of each hidden layer.
        spread: weight of the term that keeps codes apart.
        steps: training steps.
        batch: rows a step.
        rate: Adam's step size at the start; it falls to zero on a cosine.
        seed: of everything random.
        size_m: codes fill a cube of about this edge, so that lengths are of the order of metres.
    """

    hidden: int = 128
    spread: float = 0.1
    steps: int = 2000
    batch: int = 256
    rate: float = 2e-3
    seed: int = 0
    size_m: float = 100.0

    def __post_init__(self) -> None:
        if self.hidden < 1 or self.steps < 1 or self.batch < 4:
            raise ValueError(
                f"encoder: hidden={self.hidden}, steps={self.steps}, batch={self.batch}: "
                "expected at least 1, 1 and 4"
            )


class Autoencoder(nn.Module):
    """Features -> 3 numbers in (-1, 1) -> features.

    Args:
        width: number of features F.
        settings: see there.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, width: int, settings: EncoderSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = _layers(width, settings.hidden, CODE)
        self.decoder = _layers(CODE, settings.hidden, width)
        # Stored with the encoder: new uplinks are normalised alike.
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def normalised(self, features: Tensor) -> Tensor:
        """Features (B, F) with the stored mean and scale removed."""
        return (features - self.mean) / self.scale

    def code(self, features: Tensor) -> Tensor:
        """Places (B, 3) in (-1, 1)."""
        return torch.tanh(self.encoder(self.normalised(features)) / 2)


def _layers(width: int, hidden: int, out: int) -> nn.Sequential:
    first, second = nn.Linear(width, hidden), nn.Linear(hidden, hidden)
    return nn.Sequential(first, nn.GELU(), second, nn.GELU(), nn.Linear(hidden, out))


def spread(codes: Tensor) -> Tensor:
    """Mean of -log of the distance from codes (B, 3) to the nearest other; small where they fill space.

    Minus the entropy of Kozachenko and Leonenko (1987), up to constants.
    """
    apart = torch.cdist(codes, codes) + torch.eye(len(codes), device=codes.device) * 1e3
    return -(apart.min(dim=1).values + 1e-4).log().mean()


def train(features: Tensor, settings: EncoderSettings) -> Autoencoder:
    """Fit on features (n, F); deterministic in the seed."""
    generator = torch.Generator().manual_seed(settings.seed)
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        model = Autoencoder(features.shape[1], settings)
    model.mean.copy_(features.mean(0))
    model.scale.copy_(features.std(0, correction=0).clamp_min(1e-6))
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    for _ in range(settings.steps):
        rows = torch.randint(len(features), (settings.batch,), generator=generator)
        batch = features[rows]
        codes = model.code(batch)
        lost = (model.decoder(codes) - model.normalised(batch)).square().mean()
        loss = lost + settings.spread * spread(codes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return model.eval().requires_grad_(False)
