"""Traced shoebox rooms as arrays of the schema of own measurements, and random places in them."""

import numpy as np

from gsparc.simulate.shoebox import Room, Trace


def as_arrays(trace: Trace) -> dict[str, np.ndarray]:
    """Arrays for `write_own` or `from_arrays`;
    `source_gain` is the amplitude at 1 m without the wavelength.

    The sources are the images of a static transmitter,
    or of the array's centre for a static receiver.
    """
    still = trace.tx if (trace.tx == trace.tx[0]).all() else trace.rx
    arrays = {
        "rx_position": _compact(trace.rx),
        "tx_position": _compact(trace.tx),
        "csi": trace.csi,
        "frequency_hz": trace.frequency_hz,
        "source_position": trace.images.mirror_points(still[0]),
        "source_gain": trace.images.gain,
        "source_order": trace.images.order,
        "source_visible": trace.visible,
    }
    if len(trace.array) > 1:
        arrays["array_position"] = trace.array
    if trace.noise_variance > 0:
        arrays["noise_variance"] = np.array(trace.noise_variance)
    return arrays


def _compact(position: np.ndarray) -> np.ndarray:
    """(3,) when all rows are the same, else (S, 3)."""
    return position[0] if (position == position[0]).all() else position


def scatter(room: Room, count: int, seed: int, margin: float = 0.2) -> np.ndarray:
    """`count` positions (S, 3) [m] drawn uniformly in the room, `margin` [m] from walls,
    off occluders.
    """
    rng = np.random.default_rng(seed)
    low, high = np.asarray(room.lower) + margin, np.asarray(room.upper) - margin
    points = np.empty((0, 3))
    while len(points) < count:
        drawn = rng.uniform(low, high, size=(2 * count, 3))
        points = np.concatenate([points, drawn[room.contains(drawn)]])
    return points[:count]
