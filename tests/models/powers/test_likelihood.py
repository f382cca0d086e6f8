"""The likelihood with autograd is that of the plain process."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsparc.models.powers.field import left_out_losses
from gsparc.processes.density import LeftOutDensity, gram_of
from gsparc.processes.kernel import Kernel


@pytest.mark.parametrize(
    "kernel", [Kernel((0.3,), (1.0,), 0.1, 2.0), Kernel((0.1, 0.5), (0.3, 0.7), 0.1, 3.0)]
)
def test_it_is_the_plain_one(kernel):
    rng = np.random.default_rng(0)
    places, values = torch.from_numpy(rng.uniform(size=(30, 3))), torch.from_numpy(rng.normal(size=30))
    terms, distance = torch.from_numpy(np.c_[np.ones(30), rng.normal(size=30)]), torch.cdist(places, places)
    gram = gram_of(torch.from_numpy(kernel.parameters()), distance, terms)
    density, amplitude = LeftOutDensity.apply(gram, values[:, None], 1, False)
    losses = left_out_losses(gram, values, amplitude.log())
    assert float(losses.sum()) == pytest.approx(float(density), rel=1e-9)
