"""Where a static receiver sees the transmitters: the test of its pose."""

import numpy as np

from gsparc.data.schema import Measurements


def boresight_degrees(data: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Elevation and azimuth (S,), (S,) [degrees] of the transmitters in the receiver's frame."""
    local = np.einsum("sji,sj->si", data.rx_rotation, data.tx - data.rx_position)
    elevation = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    return np.degrees(elevation), np.degrees(azimuth) % 360
