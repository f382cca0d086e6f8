"""A network that changes Gaussians from query to query: what WRF-GS+ and SwiftWRF have in common."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from gsparc.field.encoding import EncodingSettings, PositionEncoding


def perceptron(
    inner: int, outer: int, width: int, depth: int, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """`depth` hidden layers of `width`."""
    sizes = [inner, *[width] * depth]
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), activation())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outer))


class Deformation(nn.Module):
    """(place of a Gaussian, query) -> changes of its attributes; zero before training.

    Args:
        places: (2, 3) [m], box that the Gaussians start in.
        queries: (2, 3) [m], box of the moving end.
        outputs: numbers per Gaussian.
        width, depth: of the network.
        octaves: of the Fourier features of both inputs.
    """

    def __init__(
        self, places: Tensor, queries: Tensor, outputs: int, width: int, depth: int, octaves: int
    ) -> None:
        super().__init__()
        settings = EncodingSettings("fourier", octaves)
        self.place, self.query = PositionEncoding(settings, places), PositionEncoding(settings, queries)
        # The first layer is linear: its two halves are added instead of writing every pair of inputs out.
        self.by_place = nn.Linear(self.place.width, width)
        self.by_query = nn.Linear(self.query.width, width)
        self.rest = perceptron(width, outputs, width, depth - 1)
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, places: Tensor, queries: Tensor) -> Tensor:
        """places (N, 3) [m], queries (B, 3) [m] -> (B, N, outputs)."""
        hidden = self.by_place(self.place(places)) + self.by_query(self.query(queries)).unsqueeze(1)
        return self.rest(torch.relu(hidden))
