"""Static ends so far from all rows that their places, or the rows', are something else."""

from __future__ import annotations

import numpy as np

from gsparc.data.checks.outliers import too_far
from gsparc.data.links.georeference import Georeference

WIDTHS = 30.0  # of the rows' box
FAR_M, TOO_FAR_M = 1e4, 1e6  # from there on positions in float32 move in steps of centimetres
APART_M = 200.0  # in height, between a station and all rows


def far_ends(still: np.ndarray, moving: np.ndarray, origin: Georeference | None) -> tuple[str, bool]:
    """What is wrong with the places of static ends, empty where nothing is, and whether that is certain.

    Args:
        still: (T, 3) places of static ends, in the world [m].
        moving: (S, 3) places of rows.
        origin: where the world's origin lies; None where places came in metres.
    """
    still = still[np.isfinite(still).all(axis=1)]
    rows = moving[~too_far(moving)]
    low, high = rows.min(axis=0), rows.max(axis=0)
    width = float(np.ptp(rows[:, :2], axis=0).max())

    def beyond(place: np.ndarray) -> np.ndarray:  # distances (n,) from the box of the rows
        return np.linalg.norm(np.maximum(low[:2] - place, 0) + np.maximum(place - high[:2], 0), axis=1)

    distance = beyond(still[:, :2])
    far = int(distance.argmax())
    if distance[far] > max(WIDTHS * width, FAR_M):
        turned, axes = still[far : far + 1, 1::-1], "x and y"
        if origin is not None:
            latitude, longitude = origin.to_degrees(still[far : far + 1, :2])
            turned, axes = still[far : far + 1, :2], "latitude and longitude"
            if (np.abs(longitude) <= 90).all():
                turned = origin.from_degrees(longitude, latitude)
        swapped = bool(beyond(turned)[0] < 0.1 * distance[far])
        hint = f"are {axes} swapped?" if swapped else "are both in one system and unit?"
        said = (
            f"a static end {distance[far] / 1e3:.4g} km from all rows, which reach over {width:.4g} m; {hint}"
        )
        return said, swapped or bool(distance[far] > TOO_FAR_M)
    below, above = float(low[2] - still[:, 2].min()), float(still[:, 2].max() - high[2])
    if max(below, above) > APART_M:
        side = "below" if below > above else "above"
        said = f"a static end {max(below, above):.4g} m {side} all rows"
        return f"{said}: heights above the sea beside heights above the ground?", False
    return "", False
