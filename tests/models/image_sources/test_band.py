"""A quarter of the band is measured; delays from positions extrapolate to the rest."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from rooms import nmse, shoebox

from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.training.context import FitContext

QUARTERS = 4
log = logging.getLogger(__name__)  # `pytest -o log_cli=true -o log_cli_level=INFO` shows the figures


@pytest.mark.slow
@pytest.mark.parametrize(("tones", "width_hz"), [(26, 20e6), (256, 100e6)])
def test_the_whole_band_from_its_lowest_quarter(tones, width_hz, tmp_path):
    """Receivers and tones that nobody measured, in a room with a pillar; NMSE of each quarter of the band."""
    frequency = 2.4e9 + np.linspace(0, width_hz, tones)
    _, data, fold = shoebox(450, pillar=True, frequency_hz=frequency)
    mask = np.zeros(data.target.shape, bool)
    mask[..., : tones // QUARTERS] = True
    method = ImageSourceGP(searches=1, clutter=False)
    report = method.fit(replace(data, mask=mask), fold, FitContext(tmp_path))
    batch = data.batch(fold.test)
    predicted, true = method.predict(batch).mean.numpy(), batch.target.numpy()
    parts = np.array_split(np.arange(tones), QUARTERS)
    errors = [nmse(predicted[..., part], true[..., part]) for part in parts]
    log.info("%d tones: NMSE %s by quarter of the band, %.0f s", tones, np.round(errors, 4), report.seconds)
    assert max(errors) < 0.06
    assert max(errors) < 1.5 * errors[0]  # as good where nothing was measured
