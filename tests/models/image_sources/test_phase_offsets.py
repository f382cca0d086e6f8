"""Snapshots with a phase and a delay of their own."""

from dataclasses import replace

import numpy as np
import pytest
from gains import fitted
from rooms import nmse, shoebox

from gsparc.models.image_sources.method import ImageSourceGP

FREQUENCY = 2.4e9 + np.arange(16) * 5e6
SMALL = (3.0, 2.5, 2.2)


def _offset(data, delays):
    rng = np.random.default_rng(0)
    phase = rng.uniform(-np.pi, np.pi, len(data))
    delay = rng.uniform(-20e-9, 20e-9, len(data)) * delays
    turn = phase[:, None] - 2 * np.pi * delay[:, None] * (FREQUENCY - data.site.carrier_hz)
    return replace(data, target=(data.target * np.exp(1j * turn)[:, None]).astype(np.complex64))


@pytest.mark.slow
@pytest.mark.parametrize("offsets", ["none", "phase", "phase_timing"])
def test_sources_are_found_through_unknown_offsets_that_are_estimated(offsets, tmp_path):
    """After one free complex number per sample: unseen snapshots have unknown phases too."""
    _, data, fold = shoebox(150, size=SMALL, max_order=1, frequency_hz=FREQUENCY, reflection=-0.5)
    seen = _offset(data, offsets == "phase_timing")
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
