"""A multilayer perceptron that gives a probability to each place of a grid, by cross-entropy.

The grid is training places that cover the site; a row's label is the nearest of them.
"""

from __future__ import annotations

import copy
import time
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from gsparc.apps.locate.baselines.methods import Locator, mean_place, without_gaps
from gsparc.processes.neighbourhood import covering

BATCH, RATE = 64, 1e-3
HIDDEN = 256  # units of each of two layers
MOST = 1_000  # places of the grid
DROPPED = 0.3  # of hidden units
HELD = 0.1  # of the rows, that end the training
PATIENCE = 15  # epochs that place these no better


def network(features: np.ndarray, places: np.ndarray, budget_s: float = 60.0, seed: int = 0) -> Locator:
    """See `methods`; trained for so long at most, the seed is of weights, order and held-out rows."""
    end = time.perf_counter() + budget_s
    return without_gaps(partial(_fitted, end=end, seed=seed), features, places)


def _fitted(rows: np.ndarray, places: np.ndarray, end: float, seed: int) -> Locator:
    """By Adam until held-out rows are placed no better, or a time [s] is over; the best weights are kept."""
    grid = np.unique(places, axis=0)
    grid = grid[covering(grid, MOST, seed)]
    label = torch.from_numpy(cKDTree(grid).query(places)[1])
    mean, deviation = rows.mean(), rows.std() or 1.0

    def inputs(rows: np.ndarray) -> Tensor:
        return torch.from_numpy((rows - mean) / deviation).float()

    @torch.no_grad()
    def locate(rows: np.ndarray) -> np.ndarray:
        model.eval()
        return mean_place(model(inputs(rows)).double().numpy(), grid)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        for width in (rows.shape[1], HIDDEN):
            layers += [nn.Linear(width, HIDDEN), nn.ReLU(), nn.Dropout(DROPPED)]
        model = nn.Sequential(*layers, nn.Linear(HIDDEN, len(grid)))
        known, order = inputs(rows), torch.randperm(len(rows))
        count = max(round(HELD * len(rows)), 1)
        held_out, learned = order[:count].numpy(), order[count:] if len(order) > count else order
        optimizer = torch.optim.Adam(model.parameters(), RATE)
        best, weights, waited = np.inf, copy.deepcopy(model.state_dict()), 0
        while waited < PATIENCE and time.perf_counter() < end:
            model.train()
            for batch in learned[torch.randperm(len(learned))].split(BATCH):
                optimizer.zero_grad()
                nn.functional.cross_entropy(model(known[batch]), label[batch]).backward()
                optimizer.step()
            error = np.linalg.norm(locate(rows[held_out]) - places[held_out], axis=1).mean()
            waited += 1
            if error < best:
                best, weights, waited = error, copy.deepcopy(model.state_dict()), 0
    model.load_state_dict(weights)
    return locate
