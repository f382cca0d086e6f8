"""Simulated levels over places, with columns that say something of them, or with known ends."""

import numpy as np
from scipy.spatial.distance import cdist

ROWS = 300


def fields(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2) [m], and levels (n, count) [dB] of transmitters there."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, [600, 400], (ROWS, 2))
    root = np.linalg.cholesky(36 * np.exp(-cdist(place, place) / 80) + 1e-6 * np.eye(ROWS))
    away = [
        np.hypot(15, cdist(place, rng.uniform(0, [600, 400], (1, 2)))[:, 0]) for _ in range(count)
    ]
    return place, np.stack([-30 - 32 * np.log10(d) + root @ rng.normal(size=ROWS) for d in away], 1)


def truths(seed: int, kind: str) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Places, levels, and columns: what `kind` names, and some that say nothing,
    or follow the level.
    """
    rng = np.random.default_rng(seed + 100)
    place, level = fields(seed, 4 if kind == "node" else 1)
    which = rng.integers(0, 4, ROWS)
    columns = {"node": which, "phone": which % 2, "power": 3 * which + 2, "hop": which > 2}
    column = columns.get(kind, which)
    level = level[np.arange(ROWS), which] if kind == "node" else level[:, 0]
    level = level + {"phone": 4 * (which % 2), "power": 3 * which + 2}.get(kind, 0)
    level = np.where(which > 2, -70 + rng.normal(0, 2, ROWS), level) if kind == "hop" else level
    level = np.round(level + rng.normal(0, 2, ROWS))
    others = {
        "day": np.repeat(np.arange(10), ROWS // 10),
        "street": place[:, 0] // 100,
        "speed": rng.gamma(3, 3, ROWS),
        "bars": np.clip((level + 120) // 12, 0, 4),
        "asu": level + 140,
        "snr": level + 115 + rng.normal(0, 1, ROWS),
        "rsrq": np.round(-10 + (level + 90) / 8 + rng.normal(0, 1, ROWS)),
        "channel": rng.integers(0, 8, ROWS),
    }
    return place, level, others | ({kind: column} if kind else {})


def flight(seed: int) -> dict[str, np.ndarray]:
    """Arrays of a drone over three stations; shadowing of 5 dB over 40 m, noise of 2 dB."""
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(0, [300, 200], (ROWS, 2)), rng.uniform(10, 120, ROWS)]
    still = np.c_[rng.uniform(0, [300, 200], (3, 2)), rng.uniform(5, 30, 3)]
    root = np.linalg.cholesky(25 * np.exp(-cdist(place, place) / 40) + 1e-6 * np.eye(ROWS))
    station = np.arange(ROWS) % 3
    away = np.linalg.norm(place - still[station], axis=1)
    shadow = (root @ rng.normal(size=(ROWS, 3)))[np.arange(ROWS), station]
    level = -30 - 28 * np.log10(away) + shadow + rng.normal(0, 2, ROWS)
    return {"rx_position": place, "station_position": still, "station": station, "rssi_db": level}
