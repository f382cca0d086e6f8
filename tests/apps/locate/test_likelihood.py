"""Misfits of snapshots at places against what they are by definition."""

import numpy as np
import pytest
import torch

from gsparc.apps.locate.search import Trust, channel_misfit, level_misfit, spectrum_misfit

RNG = np.random.default_rng(0)


def drawn(*shape: int) -> torch.Tensor:
    return torch.from_numpy(RNG.normal(size=shape))


def test_unknown_offset_is_integrated_out():
    values, mean, variance, offset = drawn(3, 5), drawn(4, 5), drawn(4, 5).exp(), 2.0
    found = level_misfit(values, mean, variance, offset)
    for i in range(3):
        for j in range(4):
            dense = torch.diag(variance[j]) + offset**2
            apart = values[i] - mean[j]
            assert found.squared[i, j] == pytest.approx(
                float(apart @ torch.linalg.solve(dense, apart)), rel=1e-9
            )
            assert found.size[i, j] == pytest.approx(float(torch.logdet(dense)), rel=1e-9)


def test_missing_stations_change_nothing():
    values, mean, variance = drawn(2, 4), drawn(5, 4), drawn(5, 4).exp()
    values[:, 1] = torch.nan
    fewer = [0, 2, 3]
    some = level_misfit(values, mean, variance)
    without = level_misfit(values[:, fewer], mean[:, fewer], variance[:, fewer])
    assert torch.allclose(some.squared, without.squared) and torch.allclose(some.size, without.size)
    assert some.count.tolist() == [3.0, 3.0]


def test_silence_favours_places_of_weak_signals():
    values = torch.full((1, 1), torch.nan).double()
    mean, variance = torch.tensor([[-100.0], [-60.0]]).double(), torch.full((2, 1), 9.0).double()
    found = level_misfit(values, mean, variance, 0.0, torch.full((1, 1), -90.0).double())
    assert found.silent[0, 0] > -0.01 and found.silent[0, 1] < -20
    assert found.squared.abs().max() == 0 and found.count.item() == 0


@pytest.mark.parametrize("known", [False, True])
def test_unknown_phase_is_removed(known):
    mean = torch.complex(drawn(4, 6), drawn(4, 6))
    values = mean[1:2] * np.exp(1.3j)
    found = channel_misfit(values, mean, torch.ones(4, 6).double(), known).squared[0]
    assert int(found.argmin()) == 1 or known
    assert (found[1] < 1e-9) != known


def test_spectra_are_compared_pixel_by_pixel():
    values, mean, variance = drawn(3, 50), drawn(4, 50), drawn(4, 1).exp()
    found = spectrum_misfit(values, mean, variance).squared
    expected = ((values[:, None] - mean) ** 2).sum(2) / variance[:, 0]
    assert torch.allclose(found, expected, rtol=1e-9)


def test_heavy_tail_forgives_a_bad_snapshot():
    values, mean = torch.full((1, 20), 8.0).double(), torch.zeros(2, 20).double()
    mean[1] = 1.0
    found = level_misfit(values, mean, torch.ones(2, 20).double())
    light, heavy = (Trust(1.0, 1.0, tail).log_likelihood(found)[0] for tail in (1e6, 2.0))
    assert light[1] - light[0] > 100 and 0 < heavy[1] - heavy[0] < 10
