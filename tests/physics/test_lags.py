import numpy as np
import pytest
import torch

from gsparc.ops import SphereGrid
from gsparc.physics.lags import SpectrumLags

GRID, WAVELENGTH = SphereGrid.hemisphere(18, 72), 0.125
ELEMENTS = np.stack(
    [*np.meshgrid(np.arange(4) * 0.0625, np.arange(3) * 0.0625), np.zeros((3, 4))], -1
).reshape(-1, 3)


def bartlett(channels):
    """Power (H, W) of one or more channels (K, M), by the definition."""
    directions = GRID.directions().numpy().reshape(-1, 3)
    steering = np.exp(2j * np.pi / WAVELENGTH * directions @ ELEMENTS.T)
    return (np.abs(steering.conj() @ channels.T) ** 2).mean(1).reshape(18, 72) / len(ELEMENTS) ** 2


def test_a_plane_wave_has_the_atom_of_its_direction():
    space = SpectrumLags(ELEMENTS, GRID, WAVELENGTH)
    direction = np.array([0.3, -0.5, 0.0])
    direction[2] = np.sqrt(1 - (direction**2).sum())
    wave = np.exp(2j * np.pi / WAVELENGTH * ELEMENTS @ direction)
    image = space.spectrum(space.plane_wave_lags(torch.tensor(direction).float()[None]))
    np.testing.assert_allclose(image[0], bartlett(wave[None]), atol=1e-5)


def test_lags_hold_the_whole_spectrum():
    """Interference of waves on several tones is in the span too: nothing is lost but rounding."""
    rng = np.random.default_rng(0)
    channels = rng.normal(size=(5, 12)) + 1j * rng.normal(size=(5, 12))
    power = torch.from_numpy(bartlett(channels)).float()[None]
    space = SpectrumLags(ELEMENTS, GRID, WAVELENGTH)
    assert space.count == 35  # (2 * 4 - 1) * (2 * 3 - 1)
    again = space.spectrum(space.to_lags(power))
    np.testing.assert_allclose(again, power, atol=1e-4 * float(power.max()))


def test_an_image_no_array_could_measure_is_not_in_the_span():
    space = SpectrumLags(ELEMENTS, GRID, WAVELENGTH)
    noise = torch.rand(1, 18, 72)
    assert (
        space.spectrum(space.to_lags(noise)) - noise
    ).square().sum() > 0.05 * noise.square().sum()
    with pytest.raises(RuntimeError):
        space.to_lags(torch.rand(1, 18, 71))
