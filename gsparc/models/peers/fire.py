"""A network in the style of FIRE: a variational autoencoder from one antenna's uplink to its downlink.

After Liu et al., "FIRE: Enabling reciprocity for FDD MIMO systems", MobiCom 2021: the code represents the
paths, and the decoder evaluates them in the other band. Sizes and training are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.method import Prediction
from gsparc.models.peers.trained import perceptron
from gsparc.models.uplink.interface import UplinkMethod, rms
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import TimeBudget


class Network(nn.Module):
    """Complex (B, L) -> complex (B, K) through a Gaussian code."""

    def __init__(self, inputs: int, outputs: int, hidden: int, code: int) -> None:
        super().__init__()
        # Of every number of the code a mean and the logarithm of its variance.
        self.encoder = perceptron(2 * inputs, 2 * code, hidden, 2, nn.GELU)
        self.decoder = perceptron(code, 2 * outputs, hidden, 2, nn.GELU)

    def forward(self, uplink: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the downlink (B, K) and the code's divergence from a standard normal (B,)."""
        middle, log_variance = self.encoder(torch.view_as_real(uplink).flatten(1)).chunk(2, dim=1)
        code = middle if noise is None else middle + noise * (log_variance / 2).exp()
        # KL divergence of N(m, s^2) from N(0, 1) (Kingma and Welling 2014, appendix B).
        divergence = 0.5 * (middle.square() + log_variance.exp() - 1 - log_variance).sum(1)
        out = self.decoder(code)
        return torch.view_as_complex(out.view(len(out), -1, 2)), divergence


@dataclass(eq=False)
class Fire(UplinkMethod):
    """One network for all antennas, each snapshot at unit uplink power.

    Args:
        hidden: units of each hidden layer.
        code: numbers of the code.
        divergence: weight of the code's divergence.
        steps, batch, rate: of Adam; the rate falls to zero on a cosine.
        seed: of everything random.
    """

    name = "fire"
    hidden: int = 256
    code: int = 32
    divergence: float = 1e-4
    steps: int = 4000
    batch: int = 512
    rate: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.hidden, self.code, self.steps, self.batch) < 1:
            raise ValueError("fire: hidden, code, steps and batch must be at least 1")

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train on all antennas of train and val rows (no choice is made on val)."""
        started = TimeBudget()
        self.site = self._need_uplink(data)
        rows = data.batch(np.concatenate([fold.train, fold.val]))
        assert rows.uplink is not None
        # Both bands lose alike along the path: the uplink's level carries over to the downlink.
        scale = rms(rows.uplink)[:, None, None]
        x = (self.own(rows.uplink) / scale).flatten(0, 1)
        y = (rows.target / scale).flatten(0, 1)
        generator = torch.Generator().manual_seed(self.seed)
        # Layers draw from torch's global generator, which the caller finds as it was.
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            self._sizes = [x.shape[1], y.shape[1], self.hidden, self.code]
            self.network = Network(*self._sizes)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=self.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        for _ in range(self.steps):
            pick = torch.randint(len(x), (self.batch,), generator=generator)
            noise = torch.randn(self.batch, self.code, generator=generator)
            # Snapshots have arbitrary phase: rotating both ends augments the data.
            angle = 6.2832 * torch.rand(self.batch, 1, generator=generator)
            turn = torch.polar(torch.ones_like(angle), angle)
            guess, divergence = self.network(x[pick] * turn, noise)
            loss = (guess - y[pick] * turn).abs().square().mean() + self.divergence * divergence.mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.network.eval().requires_grad_(False)
        return FitReport(started.spent)

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; of the uplink alone."""
        uplink = self.heard(query)
        scale = rms(uplink)[:, None, None]
        own = self.own(uplink) / scale
        guess = self.network(own.flatten(0, 1))[0]
        return Prediction(guess.view(*own.shape[:2], -1) * scale)

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {"sizes": self._sizes, "network": dict(self.network.state_dict())}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site = site
        self._sizes = list(state["sizes"])
        self.network = Network(*self._sizes)
        self.network.load_state_dict(state["network"])
        self.network.eval().requires_grad_(False)
