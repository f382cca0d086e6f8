"""Few rows far beyond all others, with a gap between: damaged bytes, wrong units, sentinels.

They are named where data are checked and read, set no scale, and are learned from and tested on
unless `split.leave_out=outliers` says otherwise. A tail without a gap, or more rows than a few,
belongs to the site.
"""

from __future__ import annotations

import numpy as np

from gsparc.base.errors import list_first
from gsparc.data.georeference import Georeference
from gsparc.data.scale import FEW, few_beyond, find_strong_outliers, peak_magnitudes
from gsparc.data.schema import Measurements

FAR = 10.0  # times the farthest distance of the others from the median place
FAR_M = 50.0  # and this much farther: in a small box nothing is far
# Of a box: its margin, how wide rows lie in it at least; rows that tell
WITHIN, APART_PLACES = 0.1, 3


def too_far(positions: np.ndarray) -> np.ndarray:
    """Tell which rows (S,) of `positions` (S, 3) [m] lie far outside the region of all others."""
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return few_beyond(distance, lambda inner, outer: outer > FAR * inner and outer - inner > FAR_M)


def far_from_box(positions: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Tell which `positions` (n, 3) [m] lie as far outside the `box` (2, 3) of other rows."""
    distance, reach = (
        np.linalg.norm(positions - box.mean(0), axis=1),
        np.linalg.norm(np.ptp(box, axis=0)) / 2,
    )
    return (distance > FAR * reach) & (distance - reach > FAR_M)


def are_kilometres(positions: np.ndarray, box: np.ndarray) -> bool:
    """Tell whether a `box` (2, 3) [m] holds `positions` (n, 3)
    only when these are taken for kilometres.

    Or holds both, but these as a heap about the origin,
    and their thousandfold spread out as rows are.
    """
    margin = np.maximum(WITHIN * np.ptp(box, axis=0), LOW_M)

    def inside(places: np.ndarray) -> np.ndarray:
        return ((places >= box[0] - margin) & (places <= box[1] + margin)).all(axis=1)

    across = positions * [1e3, 1e3, 1.0]
    if not (inside(across) | inside(positions * 1e3)).all():
        return False
    spread = (
        len(positions) >= APART_PLACES
        and (np.ptp(across[:, :2], axis=0) >= WITHIN * np.ptp(box[:, :2], axis=0)).all()
    )
    return bool(spread or not inside(positions).any())


def find_gap(places: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return which places (n, 2) [m] lie beyond a gap, (n,) bool, and how wide it is [m].

    None unless the gap is ten times as wide as the places on either side, which are not few.
    """
    for axis in (0, 1):
        order = np.argsort(places[:, axis], kind="stable")
        gaps = np.diff(places[order, axis])
        cut = int(gaps.argmax()) + 1 if len(gaps) else 0
        few = max(5, FEW * len(places))
        if min(cut, len(places) - cut) < few or gaps[cut - 1] < DISTANT_M:
            continue
        wide = max(np.ptp(places[part], axis=0).max() for part in (order[:cut], order[cut:]))
        if gaps[cut - 1] > FAR * wide:
            return np.isin(np.arange(len(places)), order[cut:]), float(gaps[cut - 1])
    return None


def find_outliers(data: Measurements) -> dict[str, np.ndarray]:
    """Return rows (n,) by what is wrong with them."""
    amplitude = peak_magnitudes(data.target, data.mask)
    amplitude = amplitude ** (data.site.target.exponent / 2)  # of powers their roots
    rows_by_fault = {
        "measure far more power than all others": np.flatnonzero(find_strong_outliers(amplitude)),
        "lie far outside the region of all others": np.flatnonzero(too_far(data.moving)),
    }
    return {key: rows for key, rows in rows_by_fault.items() if len(rows)}


def outlier_warnings(data: Measurements) -> list[str]:
    """Say each kind of outlier in one sentence, with the names of the first rows."""
    advice = "if they are wrong, leave them out with split.leave_out=outliers"
    groups = find_outliers(data).items()
    return [
        f"{list_first([data.row_names[i] for i in rows])}: {fault}; {advice}"
        for fault, rows in groups
    ]


WIDTHS = 30.0  # of the rows' box
# From there on positions in float32 move in steps of centimetres
DISTANT_M, TOO_DISTANT_M = 1e4, 1e6
APART_M = 200.0  # in height, between a station and all rows
LOW_M = 0.1  # no station's height above ground where rows are higher
BENEATH_M = 2.0  # the same of one that is below 0, too: rooms may be measured from a table


def check_static_ends(
    still: np.ndarray, moving: np.ndarray, origin: Georeference | None
) -> tuple[str, bool]:
    """Say what is wrong with the places of static ends, empty: nothing,
    and whether that is certain.

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
        return np.linalg.norm(
            np.maximum(low[:2] - place, 0) + np.maximum(place - high[:2], 0), axis=1
        )

    distance = beyond(still[:, :2])
    far = int(distance.argmax())
    if distance[far] > max(WIDTHS * width, DISTANT_M):
        turned, axes = still[far : far + 1, 1::-1], "x and y"
        if origin is not None:
            latitude, longitude = origin.to_degrees(still[far : far + 1, :2])
            turned, axes = still[far : far + 1, :2], "latitude and longitude"
            if (np.abs(longitude) <= 90).all():
                turned = origin.from_degrees(longitude, latitude)
        swapped = bool(beyond(turned)[0] < 0.1 * distance[far])
        hint = f"are {axes} swapped?" if swapped else "are both in one system and unit?"
        fault = (
            f"a static end {distance[far] / 1e3:.4g} km from all rows, which reach over "
            f"{width:.4g} m"
        )
        return f"{fault}; {hint}", swapped or bool(distance[far] > TOO_DISTANT_M)
    lowest = float(still[:, 2].min())
    below, above = float(low[2]) - lowest, float(still[:, 2].max() - high[2])
    if max(below, above) > APART_M:
        side = "below" if below > above else "above"
        fault = f"a static end {max(below, above):.4g} m {side} all rows"
        return f"{fault}: heights above the sea beside heights above the ground?", False
    if 0 < np.abs(still[:, 2]).max() < LOW_M < low[2]:
        return (
            f"static ends at heights of {np.abs(still[:, 2]).max():.2g} m at most: in kilometres?"
        ), False
    if below > BENEATH_M and lowest < 0 <= low[2]:
        return f"a static end at a height of {lowest:.4g} m, below 0 and all rows: its sign?", False
    return "", False
