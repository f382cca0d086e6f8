"""Threads, in training: sums depend on the thread count.

Remedy: our operators have a fixed order of summation; torch's own reductions have not, so a run that must
repeat pins its threads (`threads=1`). Shown: operators bit-identical between 1 and 2 threads, forward and
backward, in the model's own shapes; a pinned run repeats bit for bit.
"""

from __future__ import annotations

import pytest
import torch
from campaigns import brief, compose, spectra

from gsparc.commands.train import train
from gsparc.ops import composite, make_plan


@pytest.fixture(autouse=True)
def _restore_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def fitted(tmp_path):
    _, objects = train(
        compose(*brief(spectra(tmp_path / "own.npz"), "model.field.count=200")), tmp_path / "run"
    )
    return objects.methods[0].fitted(), objects.data


def test_operators_are_bit_identical(fitted):
    model, data = fitted
    batch = data.batch(range(8))
    with torch.no_grad():
        features = model.features(batch.tx, batch.rx)
    upstream = torch.rand(8, 1, 16, 32, generator=torch.Generator().manual_seed(0))
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        g = model.gaussians
        leaves = [
            t.detach().clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, features)
        ]
        plan = make_plan(*leaves[:4], batch.rx, data.site.grid, ids=g.ids)
        raster = composite(plan, *leaves[:4], leaves[4])
        (raster.image * upstream).sum().backward()
        found.append([raster.image, *(leaf.grad for leaf in leaves), raster.means2d.grad])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True)) and found[0][1].any()


def test_a_pinned_run_repeats(tmp_path):
    file = spectra(tmp_path / "own.npz")
    states = []
    for name in ("one", "two"):
        _, objects = train(compose(*brief(file)), tmp_path / name)
        states.append(objects.methods[0].fitted().state_dict())
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


def test_torchs_own_sums_do_not():
    """Naive: trust that a sum is a sum."""
    values = torch.randn(1_000_003, generator=torch.Generator().manual_seed(0))
    halves = values[:500_000].sum() + values[500_000:].sum()
    assert halves != values.sum()
