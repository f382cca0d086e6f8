"""Factors of packets: a phase, a delay and a gain are found again from any reference."""

import numpy as np
import pytest

from gsparc.physics.row_factors import align_factors

TONES = 312.5e3 * np.r_[-26:0, 1:27]


def rows(seed=0, count=20, antennas=3):
    draw = np.random.default_rng(seed)
    shape = (count, antennas, len(TONES))
    return draw.standard_normal(shape) + 1j * draw.standard_normal(shape)


@pytest.mark.parametrize("unknown_factor", ["phase", "phase+delay", "phase+delay+gain"])
def test_what_was_put_on_rows_is_taken_off(unknown_factor):
    true, draw = rows(), np.random.default_rng(1)
    phase, delay, gain = (
        draw.uniform(0, 6.28, 20),
        draw.uniform(-2e-7, 2e-7, 20),
        draw.uniform(0.5, 2, 20),
    )
    put_on = np.exp(1j * phase)[:, None] * np.ones(len(TONES))
    if "delay" in unknown_factor:
        put_on = put_on * np.exp(-2j * np.pi * delay[:, None] * TONES)
    if "gain" in unknown_factor:
        put_on = put_on * gain[:, None]
    logged = true * put_on[:, None]
    found = align_factors(logged, true, TONES, unknown_factor)
    missed = np.abs(logged * found[:, None] - true) ** 2
    assert missed.sum() < 1e-3 * (np.abs(true) ** 2).sum()


def test_nothing_free_turns_nothing_and_silent_rows_stay():
    true = rows()
    assert (align_factors(true, true, TONES, "none") == 1).all()
    assert np.isfinite(align_factors(0 * true, true, TONES, "phase+delay+gain")).all()
    assert np.isfinite(align_factors(true, 0 * true, TONES, "phase+delay+gain")).all()
