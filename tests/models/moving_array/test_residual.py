import numpy as np
import torch

from gsparc.models.moving_array.residual import (
    energies_and_axes,
    fit_residual,
)
from gsparc.processes.kernel import Kernel

KERNEL = Kernel.from_length(2.0, 0.05)


def rows(count=40, seed=0):
    """Smooth images of 30 numbers, 6 of which vary, and their places."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 5, (count, 3)) * [1, 1, 0]
    waves = np.sin(places @ rng.normal(size=(3, 6)) + rng.uniform(0, 6, 6))
    values = waves @ rng.normal(size=(6, 30)) + 0.01 * rng.normal(size=(count, 30)) + 1
    return places, torch.from_numpy(values).float()


def test_left_out_predictions_are_those_of_the_others(monkeypatch):
    monkeypatch.setattr("gsparc.models.moving_array.residual.SPARED", 0.0)
    places, values = rows()
    predicted = fit_residual(KERNEL, places, values, 30)[1]
    others, at = np.arange(1, 40), torch.from_numpy(places)
    mean = values.mean(0)  # of all rows, as there
    weights = np.linalg.solve(KERNEL.gram(at[1:]).numpy(), (values[others] - mean).numpy())
    wanted = mean.numpy() + KERNEL.correlations(at[:1], at[1:]).numpy() @ weights
    np.testing.assert_allclose(predicted[0], wanted[0], atol=1e-3)


def test_axes_are_the_same_from_either_side():
    values = np.random.default_rng(0).normal(size=(12, 30)) * np.linspace(1, 3, 12)[:, None]
    one, two = (
        energies_and_axes(values, 5),
        energies_and_axes(np.vstack([values, np.zeros((30, 30))]), 5),
    )
    np.testing.assert_allclose(one[0], two[0])
    np.testing.assert_allclose(abs((one[1] * two[1]).sum(1)), 1)
    np.testing.assert_allclose(one[1] @ one[1].T, np.eye(5), atol=1e-12)
