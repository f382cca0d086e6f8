"""Levels at a receiver's own noise or lowest reading: found where they are, and nowhere else."""

import numpy as np
import pytest
from releases import real

from gsparc.tables.checks.link_levels import link_levels
from gsparc.tables.checks.plausibility import find_floor_pile, floor_warnings
from gsparc.tables.own import from_arrays


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


def test_a_lowest_reading_of_few_rows_is_found():
    """A tenth, at stations seldom heard, too: -140 dBm of a phone."""
    levels = np.maximum(drive(0, 600), np.quantile(drive(0, 600), 0.1))
    least, after = np.unique(levels)[:2]
    pile = find_floor_pile(levels)
    assert pile is not None and least < pile[0] == after and pile[1] == pytest.approx(0.1, abs=0.01)
    place, posts = np.random.default_rng(0).uniform(0, 99, (600, 3)), np.eye(30, 3) * 50
    arrays = {"rx_position": place, "station_position": posts, "station": np.arange(600) % 30}
    data = from_arrays(arrays | {"rssi_db": levels}, {"absent": "unknown"})
    (line,) = floor_warnings(link_levels(data))
    assert line.startswith(
        f"not heard? 10% of the levels below {said(after)} dB look like a receiver's noise or"
    )


def said(level: float) -> str:
    """As warnings write a level: hundredths, upwards."""
    return f"{np.ceil(100 * level) / 100:g}"


def told(levels: np.ndarray, **more: object) -> list[str]:
    """What is said of levels (n, T) of stations."""
    place, posts = (
        np.random.default_rng(0).uniform(0, 99, (len(levels), 3)),
        50 * np.eye(levels.shape[1], 3),
    )
    arrays = {"rx_position": place, "station_position": posts, "rssi_db": levels}
    return floor_warnings(link_levels(from_arrays(arrays | more)))


@pytest.mark.parametrize("seed", range(4))
def test_the_advice_on_a_floor_did_nothing_and_was_given_again(seed):
    """Rounded to a tenth, `sensitivity_db=-121.2` lay below the lowest reading of -121.24 dB."""
    levels = np.maximum(drive(seed), np.quantile(drive(seed), 0.5))[:, None]
    (line,) = told(levels)
    level = float(line.partition("; sensitivity_db=")[2].split()[0])
    assert level > levels.min() and told(levels, sensitivity_db=np.array(level)) == []


def test_a_stated_floor_was_called_too_low():
    """Who followed the advice was told of the next station and of a higher level;
    one not stated is named.
    """
    levels = np.stack([noisy(drive(seed), 0.8, seed) for seed in range(2)], 1)
    low = np.quantile(levels, 0.1, axis=0)
    assert len(told(levels)) == 1 and told(levels, sensitivity_db=np.array(low.max())) == []
    (line,) = told(levels, sensitivity_db=np.array([np.nan, low[1]]))
    assert "levels of station 0 below" in line


def test_the_advice_on_a_floor_was_refused_for_files_of_arrays():
    """`dataset.columns` goes with tables alone; marks named it, too."""
    (line,) = told(noisy(drive(0), 0.8, 0)[:, None])
    assert (
        "; sensitivity_db=-110.49 in the file (of a table dataset.columns.sensitivity_db=-110.49"
    ) in line


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


def test_a_citys_noise_was_learned_as_signal_without_a_word():
    """Of three stations 60 to 86 % of the levels are the receiver's noise;
    a hall's sensors have none.
    """

    def said(name: str) -> list[str]:
        with np.load(real(f"real/{name}.npz")) as stored:
            place, post = (
                np.c_[stored[k], np.zeros((len(stored[k]), 3 - stored[k].shape[1]))]
                for k in ("mobile_position", "station_position")
            )
            arrays = {"tx_position": place, "station_position": post, "rssi_db": stored["rssi_db"]}
            names = stored["station"] if "station" in stored else np.arange(len(post)).astype(str)
            levels = link_levels(from_arrays(arrays | {"station_name": names}))
            return floor_warnings(levels)

    (line,) = said("powder-rss-462mhz")
    for part in (
        "not heard? 60% of the levels of station bookstore-nuc2-b210 below -90.63 dB, 86% of",
        "68% of the levels of station ebc-nuc1-b210",
        "sensitivity_db=-88.89, or",
    ):
        assert part in line
    assert line.count("% of the levels") == 4 and said("ble-hall-1") == said("ble-hall-2") == []
