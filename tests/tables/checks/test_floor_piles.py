"""Levels at a receiver's own noise or lowest reading: found where they are, and nowhere else."""

import numpy as np
import pytest

from gsparc.tables.checks.piles import find_floor_pile


def drive(seed: int, count: int = 300) -> np.ndarray:
    """Levels (n,) [dB] of a station along a drive, shadowing with a length of twenty rows."""
    rng = np.random.default_rng(seed)
    far = np.hypot(*rng.uniform(-1000, 1000, (2, count))).clip(20)
    far = far[np.argsort(np.abs(far - np.roll(far, 1)))]
    shadow = np.convolve(rng.normal(size=count + 19), np.ones(20) / np.sqrt(20), "valid")
    return -20 - 35 * np.log10(far) + 7 * shadow + rng.normal(0, 1.5, count)


def noisy(level: np.ndarray, share: float, seed: int) -> np.ndarray:
    """What a receiver reports whose noise is above that share of the levels."""
    noise = np.quantile(level, share) + np.random.default_rng(seed).normal(0, 0.7, len(level))
    return 10 * np.log10(10 ** (level / 10) + 10 ** (noise / 10))


@pytest.mark.parametrize(("share", "least"), [(0.6, 9), (0.8, 18)])
def test_levels_at_the_noise_are_found(share, least):
    found = [find_floor_pile(noisy(drive(seed), share, seed)) for seed in range(20)]
    assert sum(pile is not None for pile in found) >= least
    for seed, pile in enumerate(found):
        if pile is not None:
            noise = np.quantile(drive(seed), share)
            assert noise < pile[0] < noise + 4 and pile[1] > share - 0.25


def test_a_lowest_reading_is_found():
    levels = [np.maximum(level, np.quantile(level, 0.5)).round() for level in map(drive, range(20))]
    piles = [find_floor_pile(level) for level in levels]
    assert sum(pile is not None for pile in piles) >= 19


def lists(seed: int) -> np.ndarray:
    """Levels of one of six stations where it is among the three strongest."""
    every = np.stack([drive(6 * seed + i) for i in range(6)], 1)
    return every[:, 0][np.argsort(np.argsort(-every, 1), 1)[:, 0] < 3]


SOUND = {
    "drives": drive,
    "whole decibels": lambda seed: drive(seed).round(),
    "short": lambda seed: drive(seed, 40).round(),
    "lists of the strongest": lists,
    "weak ones missing": lambda seed: (level := drive(seed))[level > np.quantile(level, 0.6)],
    "a small range": lambda seed: np.random.default_rng(seed).normal(-60, 2, 300),
    "two receivers": lambda seed: np.r_[drive(seed), drive(seed + 99) + 20],
    "few": lambda seed: drive(seed)[:9],
}


@pytest.mark.parametrize("kind", SOUND)
def test_no_wolf_without_a_floor(kind):
    assert sum(find_floor_pile(SOUND[kind](seed)) is not None for seed in range(30)) <= 1
