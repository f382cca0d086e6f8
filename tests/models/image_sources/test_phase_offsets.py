"""Snapshots with a phase and a delay of their own."""

from dataclasses import replace

import numpy as np
import pytest
from gains import fitted
from rooms import nmse, shoebox

from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.phase_offsets import estimate

FREQUENCY = 2.4e9 + np.arange(16) * 5e6
SMALL = (3.0, 2.5, 2.2)


def _offset(data, delays):
    rng = np.random.default_rng(0)
    phase = rng.uniform(-np.pi, np.pi, len(data))
    delay = rng.uniform(-20e-9, 20e-9, len(data)) * delays
    turn = phase[:, None] - 2 * np.pi * delay[:, None] * (FREQUENCY - data.site.carrier_hz)
    return phase, delay, replace(data, target=(data.target * np.exp(1j * turn)[:, None]).astype(np.complex64))


def test_offsets_against_the_truth_are_exact():
    _, data, _ = shoebox(40, size=SMALL, max_order=1, frequency_hz=FREQUENCY)
    phase, delay, seen = _offset(data, True)
    found = estimate(seen.target, data.target, FREQUENCY, data.site.carrier_hz, timing=True)
    np.testing.assert_allclose(found.delay, delay, atol=1e-11)
    assert np.abs(np.angle(np.exp(1j * (found.phase - phase)))).max() < 1e-2
    restored = found.removed(seen.target, FREQUENCY, data.site.carrier_hz)
    np.testing.assert_allclose(restored, data.target, atol=2e-2 * np.abs(data.target).max())


def test_tones_not_measured_do_not_count():
    _, data, _ = shoebox(10, size=SMALL, max_order=1, frequency_hz=FREQUENCY)
    phase, _, seen = _offset(data, False)
    mask = np.ones(data.target.shape, bool)
    mask[..., 8:] = False
    spoilt = np.where(mask, seen.target, 100.0)
    found = estimate(spoilt, data.target, FREQUENCY, data.site.carrier_hz, timing=False, mask=mask)
    assert np.abs(np.angle(np.exp(1j * (found.phase - phase)))).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("offsets", ["none", "phase", "phase_timing"])
def test_sources_are_found_through_unknown_offsets_that_are_estimated(offsets, tmp_path):
    """After one free complex number per sample: unseen snapshots have unknown phases too."""
    _, data, fold = shoebox(150, size=SMALL, max_order=1, frequency_hz=FREQUENCY, reflection=-0.5)
    _, _, seen = _offset(data, offsets == "phase_timing")
    method, _ = fitted(seen, fold, tmp_path, search_rows=300, offsets=offsets)
    batch = data.batch(fold.test)
    found, true = method.predict(batch).mean.numpy(), batch.target.numpy()
    scalar = (found.conj() * true).sum((1, 2)) / (np.abs(found) ** 2).sum((1, 2))
    if offsets == "none":
        assert nmse(found, true) > 0.5
    else:
        assert nmse(found * scalar[:, None, None], true) < 0.01


def test_unknown_kind_of_offset_is_refused():
    with pytest.raises(ValueError, match="phase_timing"):
        ImageSourceGP(offsets="both")
