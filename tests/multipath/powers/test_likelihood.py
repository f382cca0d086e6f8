"""The likelihood with autograd is that of the plain process."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from gsparc.methods.power_kernel import PowerKernel, left_out
from gsparc.multipath.powers.likelihood import Covariance, left_out_losses


@pytest.mark.parametrize(
    "kernel", [PowerKernel((0.3,), (1.0,), 0.1, 2.0), PowerKernel((0.1, 0.5), (0.3, 0.7), 0.1, 3.0)]
)
def test_it_is_the_plain_one(kernel):
    rng = np.random.default_rng(0)
    places, values = rng.uniform(size=(30, 3)), rng.normal(size=30)
    terms, distance = np.c_[np.ones(30), rng.normal(size=30)], cdist(places, places)
    density, amplitude, _ = left_out(kernel, distance, terms, values)
    covariance = Covariance.of(kernel)
    gram = covariance.gram(torch.from_numpy(distance), torch.from_numpy(terms))
    assert np.allclose(gram.numpy(), kernel.gram(distance, terms))
    losses = left_out_losses(gram, torch.from_numpy(values), torch.tensor(amplitude).log())
    assert float(losses.sum()) == pytest.approx(density, rel=1e-9)
