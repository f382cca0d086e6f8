"""Sixty rows of every kind and layout of measurements, to be shuffled, doubled and cut."""

import numpy as np

POWERS = ("powers", "wide", "long", "the strongest", "both", "degrees", "devices", "not heard")
KINDS = (*POWERS, "channels", "runs", "stations' channels", "spectra", "carriers")
POSTS = np.array([[20.0, 3, 6], [-5, 30, 6], [40, 40, 9]])


def rows_of(kind: str) -> dict[str, np.ndarray]:
    """Arrays of 60 rows of a kind and layout; those named `_` belong to no row."""
    rng = np.random.default_rng(3)
    places = np.cumsum(rng.normal(size=(60, 3)), axis=0)
    waves = rng.normal(size=(60, 2, 4)) + 1j * rng.normal(size=(60, 2, 4))
    levels = np.round(
        -60 - 0.5 * np.linalg.norm(places[:, None] - POSTS, axis=2) + rng.normal(size=(60, 3)), 1
    )
    one = {"rx_position": places, "_tx_position": POSTS[0]}
    station = rng.permutation(np.arange(60) % 3)
    east = rng.uniform(0, 0.01, (63, 2))
    return {
        "powers": {**one, "rssi_db": levels[:, 0]},
        "wide": {"rx_position": places, "_station_position": POSTS, "rssi_db": levels},
        "long": {
            "rx_position": places,
            "_station_position": POSTS,
            "station": station,
            "rssi_db": levels[np.arange(60), station],
        },
        "both": {"rx_position": places, "tx_position": places[::-1] + 9, "rssi_db": levels[:, 0]},
        "degrees": {
            "latitude": 48 + east[:60, 0],
            "longitude": 11 + east[:60, 1],
            "rssi_db": levels,
            "_station_latitude": 48 + east[60:, 0],
            "_station_longitude": 11 + east[60:, 1],
            "_rx_height": np.array(1.5),
            "_station_height": np.array(20.0),
        },
        "devices": {**one, "rssi_db": levels[:, 0] + 4 * (station == 1), "device": station},
        "not heard": {
            "rx_position": places,
            "_station_position": POSTS,
            "_sensitivity_db": np.array(-77.0),
            "rssi_db": np.where(levels < -77, np.nan, levels),
        },
        "channels": {**one, "csi": waves, "_frequency_hz": 5e9 + 1e6 * np.arange(4)},
        "runs": {**one, "csi": waves, "_frequency_hz": 5e9 + 1e6 * np.arange(4), "run": station},
        "the strongest": {
            "rx_position": places,
            "_station_position": POSTS,
            "rssi_db": np.where(levels < np.sort(levels, 1)[:, 1:2], np.nan, levels),
        },
        "stations' channels": {
            "rx_position": places,
            "_station_position": POSTS,
            "csi": rng.normal(size=(60, 3, 2, 4)) + 0j,
            "_frequency_hz": 5e9 + np.arange(4),
        },
        "spectra": {
            "_rx_position": POSTS[0],
            "tx_position": places,
            "spectrum": rng.uniform(size=(60, 12, 24)),
        },
        "carriers": {
            "_rx_position": POSTS[0],
            "tx_position": places,
            "carrier_hz": 2e9 + 1e9 * station,
            "spectrum": rng.uniform(size=(60, 12, 24)),
        },
    }[kind]
