import numpy as np
import pytest

from gsparc.ops import SphereGrid
from gsparc.simulate.paths import TracedPaths
from gsparc.simulate.spectrum import SpectrumSettings, render_spectra

WAVELENGTH = 0.125
TONES = 2.4e9 + np.linspace(-40e6, 40e6, 7)


def arriving(directions, powers, delays=None):
    """One receiver hearing plane waves."""
    count = len(directions)
    unit = np.array(directions, float)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    delays = np.arange(count) * 1e-8 if delays is None else np.array(delays)
    return TracedPaths(
        np.array([0, count]),
        np.sqrt(np.array(powers))[:, None].astype(np.complex64),
        delays,
        unit.astype(np.float32),
        np.zeros(count, np.uint8),
        np.zeros(count, np.uint8),
    )


def random_waves(count=9, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return arriving(directions, rng.uniform(0.1, 1, count), rng.uniform(0, 1e-7, count))


def test_bartlett_by_lags_equals_the_definition():
    """|a^H h|^2 averaged over the tones, element by element."""
    settings, waves = SpectrumSettings(rows=4, columns=3), random_waves()
    images, peak = render_spectra(waves, settings, TONES, WAVELENGTH)
    elements = settings.elements(WAVELENGTH)
    h = waves.responses(TONES, elements, WAVELENGTH)[0]
    directions = settings.grid.directions().numpy().reshape(-1, 3)
    steering = np.exp(2j * np.pi / WAVELENGTH * directions @ elements.T)
    power = (np.abs(steering.conj() @ h) ** 2).mean(1) / len(elements) ** 2
    np.testing.assert_allclose((images[0].ravel() * peak[0]) ** 2, power, atol=1e-5 * power.max())
    assert images.max() == pytest.approx(1.0)


def test_wave_is_brightest_in_its_pixel():
    grid = SphereGrid.hemisphere()
    for row, column in ((40, 37), (60, 200), (30, 359)):
        wave = arriving([grid.directions()[row, column].numpy()], [1.0])
        image = render_spectra(wave, SpectrumSettings(), TONES, WAVELENGTH)[0][0]
        found = np.unravel_index(image.argmax(), image.shape)
        assert found == (row, column)


def test_waves_from_below_the_horizon_are_not_received():
    up = arriving([[1, 1, 1]], [1.0])
    both = arriving([[1, 1, 1], [0, 1, -1]], [1.0, 5.0])
    one, other = (render_spectra(w, SpectrumSettings(), TONES, WAVELENGTH)[0] for w in (up, both))
    np.testing.assert_array_equal(one, other)


def test_silence_is_black():
    silent = random_waves(seed=1).select_paths(np.zeros(9, bool))
    image, divided = render_spectra(silent, SpectrumSettings(), TONES, WAVELENGTH)
    assert not image.any() and divided[0] == 1.0


def test_both_polarisations_add_their_powers():
    waves = random_waves(seed=2)
    doubled = TracedPaths(
        waves.offsets,
        np.repeat(waves.gain, 2, axis=1),
        waves.delay,
        waves.direction,
        waves.mechanisms,
        waves.order,
    )
    (one, low), (two, high) = (
        render_spectra(w, SpectrumSettings(), TONES, WAVELENGTH) for w in (waves, doubled)
    )
    np.testing.assert_allclose(one, two, atol=1e-6)
    assert high[0] == pytest.approx(2**0.5 * low[0], rel=1e-5)
