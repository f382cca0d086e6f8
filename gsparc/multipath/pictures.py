"""Learned against true visibility, source by source, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure


def plot_visibility(
    path: str | Path,
    places: np.ndarray,
    learned: np.ndarray,
    true: np.ndarray,
    names: Sequence[str],
) -> Path:
    """Write a PNG: a column per source, learned above true; blue is unseen, yellow is fully seen.

    Args:
        path: of the PNG; its folder is made.
        places: (n, 3) [m], where receivers stand; drawn in x and y.
        learned: (n, K), |gain| relative to a source that is fully seen.
        true: (n, K) bool or share.
        names: of the K sources.

    Returns:
        The path written.
    """
    count = learned.shape[1]
    figure = Figure(figsize=(2.2 * count + 0.8, 4.6), layout="constrained")
    axes = figure.subplots(2, count, squeeze=False, sharex=True, sharey=True)
    shades = {"vmin": 0.0, "vmax": 1.0, "cmap": "cividis", "s": 9}
    for k in range(count):
        for row, values in enumerate((learned, true)):
            drawn = axes[row, k].scatter(places[:, 0], places[:, 1], c=values[:, k].astype(float), **shades)
            axes[row, k].set_aspect("equal")
        agree = np.corrcoef(learned[:, k], true[:, k])[0, 1] if np.ptp(true[:, k].astype(float)) else np.nan
        axes[0, k].set_title(f"{names[k]}\ncorrelation {agree:.2f}", fontsize=8)
        axes[1, k].set_xlabel("x [m]")
    axes[0, 0].set_ylabel("learned\ny [m]")
    axes[1, 0].set_ylabel("true\ny [m]")
    figure.colorbar(drawn, ax=axes, shrink=0.7, label="seen")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path
