"""Channels as Wi-Fi cards log them: those of a robot's runs, each row with factors of its own."""

import numpy as np
from releases import release

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw

RUNS = 5


def robot(
    transmitter: int = 0, first: int = 0, layout: str = "los"
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Places (n, 3) [m], frequencies, the transmitter's place; channels (n, 30),
    coherent within runs.
    """
    released = np.load(release(f"ofdm/wsr-{layout}-a.npz"))
    channel = released["root_sign"] * np.sqrt(released["h2"])
    good = released["good"] & (released["tx_index"] == transmitter) & (channel != 0).all(1)
    runs = np.unique(released["run"][good])[first : first + RUNS]
    good &= np.isin(released["run"], runs)
    given = {
        "rx_position": released["rx_position"][good],
        "tx_position": released["tx_position"][transmitter],
        "frequency_hz": released["subcarrier_hz"],
        "run": released["run"][good],
    }
    return given, channel[good]


def logged(channel: np.ndarray, tones: np.ndarray, seed: int, gain_db: float = 0.0) -> np.ndarray:
    """The same with a phase, a delay of 0 to 50 ns and a gain of +-`gain_db` of each row's own."""
    draw, rows = np.random.default_rng(seed), len(channel)
    phase, delay = draw.uniform(0, 2 * np.pi, rows), draw.uniform(0, 50e-9, rows)
    gain = 10 ** (draw.uniform(-gain_db, gain_db, rows) / 20)
    return (
        channel * gain[:, None] * np.exp(1j * (phase[:, None] - 2 * np.pi * delay[:, None] * tones))
    )


def measurements(given: dict[str, np.ndarray], channel: np.ndarray) -> Measurements:
    """As the arrays of a file."""
    return interpret(Raw({**given, "csi": channel.astype(np.complex64)}, {}), "packets").data


def shares(data: Measurements, seed: int, side: float | None = None) -> Fold:
    """A fifth of the rows to test, at random or whole squares of `side` [m]."""
    draw, count = np.random.default_rng(seed), len(data)
    group = np.arange(count)
    if side is not None:
        cells = np.floor(data.moving[:, :2] / side + draw.uniform(0, 1, 2)).astype(int)
        group = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    order = draw.permutation(group.max() + 1)
    tested = np.isin(group, order[: max(1, len(order) // 5)])
    return Fold(np.flatnonzero(~tested), np.zeros(0, np.int64), np.flatnonzero(tested))
