"""Which split answers which question about these places."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gsparc.data.schema import Measurements
from gsparc.data.splits import SplitSettings, make_split

ROUND = (1.0, 2.0, 3.0, 5.0, 10.0)
APART = 3.0  # least side of a square, in distances of neighbours


def side_of_squares(data: Measurements) -> float | None:
    """Side [m] for `split=blocks`: a tenth of the site and several neighbours wide, a round number.

    None where the places are too few to hold squares of them out.
    """
    places = np.unique(data.moving[:, -3:], axis=0)[:, :2]
    extent = float(np.ptp(places, axis=0).max()) if len(places) > 1 else 0.0
    if extent == 0:
        return None
    apart = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
    least = max(extent / 10, APART * apart)
    decade = 10 ** np.floor(np.log10(least))
    side = next(float(decade * step) for step in ROUND if decade * step >= 0.99 * least)
    return side if side < extent / 2 else None


def held_out(data: Measurements, side: float) -> np.ndarray:
    """Rows that `split=blocks split.side_m=<side>` tests on; none where it cannot be cut so."""
    try:
        settings = SplitSettings("blocks", side_m=side)
        split = make_split(data.moving, settings, None, np.zeros(0, np.int64), data.place, data.station)
        split.check()
    except ValueError:
        return np.zeros(0, np.int64)
    return split.folds[0].test


def proposal(data: Measurements) -> str:
    """One sentence for `gsparc check`."""
    between = "split=random asks about places between these"
    side = side_of_squares(data)
    if side is None or not len(held_out(data, side)):
        return f"{between}; too few places to hold out squares of floor"
    return f"{between}; split=blocks split.side_m={side:g} about holes of {side:g} m"
