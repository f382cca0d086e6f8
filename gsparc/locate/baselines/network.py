"""A multilayer perceptron that gives a probability to each place of a grid, by cross-entropy.

The grid is training places that cover the site; a row's label is the nearest of them.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gsparc.locate.baselines.interface import Estimate, filled, floor_of
from gsparc.processes.neighbourhood import covering

BATCH, RATE = 64, 1e-3
HIDDEN = 256  # units of each of two layers
MOST = 1_000  # places of the grid
DROPPED = 0.3  # of hidden units
HELD = 0.1  # of the rows, that end the training
PATIENCE = 15  # epochs that place these no better


@dataclass(frozen=True)
class Classifier:
    """A network of features, less a mean and over a deviation, to logits (m, G) of a grid (G, D) [m]."""

    network: nn.Module
    grid: np.ndarray
    floor: float
    scale: tuple[float, float]

    @torch.no_grad()
    def locate(self, features: np.ndarray) -> Estimate:
        """See `Locator`."""
        self.network.eval()
        return Estimate.over(self.grid, self.network(self.inputs(features)).double().numpy())

    def inputs(self, features: np.ndarray) -> Tensor:
        """What the network is given (m, P) float32."""
        return torch.from_numpy((filled(features, self.floor) - self.scale[0]) / self.scale[1]).float()


def fit(features: np.ndarray, places: np.ndarray, budget_s: float = 60.0, seed: int = 0) -> Classifier:
    """Trained for so long at most; the seed is of weights, order and held-out rows."""
    end, floor = time.perf_counter() + budget_s, floor_of(features, places)
    rows, grid = filled(features, floor), np.unique(places, axis=0)
    grid = grid[covering(grid, MOST, seed)]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        for width in (rows.shape[1], HIDDEN):
            layers += [nn.Linear(width, HIDDEN), nn.ReLU(), nn.Dropout(DROPPED)]
        network = nn.Sequential(*layers, nn.Linear(HIDDEN, len(grid)))
        found = Classifier(network, grid, floor, (float(rows.mean()), float(rows.std()) or 1.0))
        _train(found, features, places, end)
    return found


def _train(found: Classifier, features: np.ndarray, places: np.ndarray, end: float) -> None:
    """Adam until held-out rows are placed no better, or a time [s] is over; the best weights are kept."""
    inputs, label = found.inputs(features), torch.from_numpy(cKDTree(found.grid).query(places)[1])
    order = torch.randperm(len(inputs))
    count = max(round(HELD * len(inputs)), 1)
    held, learned = order[:count].numpy(), order[count:] if len(order) > count else order
    optimizer = torch.optim.Adam(found.network.parameters(), RATE)
    best, kept, waited = np.inf, copy.deepcopy(found.network.state_dict()), 0
    while waited < PATIENCE and time.perf_counter() < end:
        found.network.train()
        for batch in learned[torch.randperm(len(learned))].split(BATCH):
            optimizer.zero_grad()
            nn.functional.cross_entropy(found.network(inputs[batch]), label[batch]).backward()
            optimizer.step()
        error = np.linalg.norm(found.locate(features[held]).place - places[held], axis=1).mean()
        waited += 1
        if error < best:
            best, kept, waited = error, copy.deepcopy(found.network.state_dict()), 0
    found.network.load_state_dict(kept)
