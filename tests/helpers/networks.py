"""Simulated networks of sectors with a known truth."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.tables.own import from_arrays

SITES, SECTORS, SIDE_M, STEP_M, BLOCK_M = 10, 3, 2500.0, 18.0, 125.0
COMMON_DB, OWN_DB, NOISE_DB, LENGTH_M = 5.0, 3.5, 1.5, 70.0  # shadowing of a site, of a cell; noise


@dataclass(frozen=True)
class Network:
    """A drive test and its truth; cells are sectors.

    Attributes:
        place: (T, 3) of the cells [m].
        azimuth, tilt: (T,) as a list of sites has them [deg].
        moment: (M, 3) places of the drive [m].
        measured: (M, T) levels there [dBm]; the strongest are listed.
        asked: (Q, 3) places beside the track and around it [m].
        truth: (Q, T) levels there, without noise [dBm].
    """

    place: np.ndarray
    azimuth: np.ndarray
    tilt: np.ndarray
    moment: np.ndarray
    measured: np.ndarray
    asked: np.ndarray
    truth: np.ndarray

    def listed(self, count: int) -> np.ndarray:
        """(M, T) bool: which cells are among the `count` strongest of each moment."""
        return np.argsort(np.argsort(-self.measured, 1), 1) < count

    def arrays(self, count: int, azimuths: bool = True) -> dict[str, np.ndarray]:
        """The drive's lists of `count` cells under the schema's names."""
        moment, cell = np.nonzero(self.listed(count))
        result = {
            "rx_position": self.moment[moment],
            "station": cell,
            "station_position": self.place,
            "station_name": np.array(
                [f"{i // SECTORS}-{i % SECTORS}" for i in range(len(self.place))]
            ),
            "rssi_db": self.measured[moment, cell],
        }
        sectors = {"station_azimuth": self.azimuth, "station_tilt": self.tilt}
        return result | (sectors if azimuths else {})

    def data(self, count: int, azimuths: bool = True) -> Measurements:
        """The same as measurements."""
        return from_arrays(self.arrays(count, azimuths), {"name": "network"})


def pattern(
    place: np.ndarray,
    cells: np.ndarray,
    azimuth: np.ndarray,
    tilt: np.ndarray,
    width: np.ndarray | float = 65.0,
    height: np.ndarray | float = 10.0,
    floor: np.ndarray | float = 25.0,
) -> np.ndarray:
    """Gains (n, T) [dB] of 3GPP TR 36.814, table A.2.1.1-2, at places (n, 3) of cells (T, 3)
    [m].
    """
    away = place[:, None] - cells
    turn = np.degrees(np.arctan2(away[..., 0], away[..., 1])) - azimuth
    turn = (turn + 180) % 360 - 180
    down = np.degrees(np.arctan2(-away[..., 2], np.hypot(away[..., 0], away[..., 1])))
    across = np.minimum(12 * (turn / width) ** 2, floor)
    return -np.minimum(across + np.minimum(12 * ((down - tilt) / height) ** 2, 20.0), floor)


def _streets(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2) places of a drive along a grid of streets [m]."""
    at, way = np.round(rng.uniform(0.3, 0.7, 2) * SIDE_M / BLOCK_M) * BLOCK_M, rng.integers(4)
    places, steps = [], np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    while len(places) < count:
        blocks = rng.integers(2, 7)
        end = at + steps[way] * blocks * BLOCK_M
        if not ((end >= 0) & (end <= SIDE_M)).all():
            way = (way + rng.choice([1, 3])) % 4
            continue
        far = np.arange(0, blocks * BLOCK_M, STEP_M)[:, None]
        places += list(at + steps[way] * far + rng.normal(0, 2, (len(far), 2)))
        at, way = end, (way + rng.choice([1, 3])) % 4
    return np.array(places[:count])


@cache
def network(seed: int, wrong: int = 0, moments: int = 700, asked: int = 250) -> Network:
    """Ten sites of three sectors; `wrong` azimuths of the list are turned by 180 degrees."""
    return draw_network(seed, wrong, moments, asked)


def draw_network(seed: int, wrong: int, moments: int, asked: int | np.ndarray) -> Network:
    """The same; places (Q, 2) that are asked may be given."""
    rng = np.random.default_rng(seed)
    sites: list[np.ndarray] = []
    while len(sites) < SITES:
        at = rng.uniform(0, SIDE_M, 2)
        if all(np.hypot(*(at - other)) > 500 for other in sites):
            sites.append(at)
    place = np.repeat(np.c_[sites, rng.uniform(22, 35, SITES)], SECTORS, 0)
    azimuth = np.repeat(rng.uniform(0, 120, SITES), SECTORS) + np.tile([0.0, 120, 240], SITES)
    cells = len(place)
    tilt = rng.uniform(3, 8, cells).round()
    walk = _streets(rng, moments)
    if isinstance(asked, int):
        beside = walk[rng.integers(moments, size=asked // 2)] + rng.normal(0, 60, (asked // 2, 2))
        asked = np.concatenate([beside, rng.uniform(0, SIDE_M, (asked - len(beside), 2))])
    every = np.concatenate([walk, asked])
    every = np.c_[every, np.full(len(every), 1.5)]
    apart = np.linalg.norm(every[:, None, :2] - every[None, :, :2], axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / LENGTH_M) + 1e-9 * np.eye(len(every)))
    shadow = COMMON_DB * np.repeat(root @ rng.normal(size=(len(every), SITES)), SECTORS, 1)
    shadow += OWN_DB * root @ rng.normal(size=(len(every), cells))
    far = np.maximum(np.linalg.norm(every[:, None] - place, axis=-1), 20)
    level = -25 - 35 * np.log10(far) + rng.normal(0, 2.5, cells) + shadow
    level += pattern(
        every,
        place,
        azimuth + rng.normal(0, 5, cells),
        tilt + rng.normal(0, 0.7, cells),
        rng.uniform(58, 75, cells),
        rng.uniform(8, 12, cells),
        rng.uniform(22, 30, cells),
    )
    measured = level[:moments] + rng.normal(0, NOISE_DB, (moments, cells))
    written = azimuth % 360
    written[rng.permutation(cells)[:wrong]] += 180
    asked, truth = every[moments:], level[moments:]
    return Network(place, written % 360, tilt, every[:moments], measured, asked, truth)


def judged(one: Network, count: int, mean: np.ndarray, spread: np.ndarray) -> dict[str, float]:
    """Figures of predictions (Q, T): of cells that a list there would have, of those it would not,
    of all.
    """
    least = one.listed(count).sum(0) >= 20
    rank = np.argsort(np.argsort(-one.truth, 1), 1)
    listed, error = rank < count, mean - one.truth
    hold, low = np.abs(error) < 1.645 * spread, ~listed & least
    return {
        "rmse": float(np.sqrt((error**2).mean())),
        "bias_unlisted": float(error[low].mean()),
        "hold": float(hold.mean()),
        "hold_listed": float(hold[listed].mean()),
        "hold_unlisted": float(hold[low].mean()),
        "best": float((mean.argmax(1) == one.truth.argmax(1)).mean()),
    }
