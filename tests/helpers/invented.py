"""A small invented dataset of any kind, and its split."""

import numpy as np

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold, Split
from gsparc.ops import SphereGrid


def invent(
    kind: str = "spectrum", rows: int = 48, static_end: str = "rx", seed: int = 0
) -> Measurements:
    """A smooth target over a 1 m cube of positions; spectra 12 x 24 bytes, channels 4 x 3,
    powers 1.
    """
    rng = np.random.default_rng(seed)
    moving = rng.uniform(-0.5, 0.5, (rows, 3))
    still = np.tile([4.0, 0.0, 0.0], (rows, 1))
    shape = {"spectrum": (12, 24), "csi": (4, 3), "rssi": (1,)}[kind]
    waves = rng.normal(size=(int(np.prod(shape)), 3)) * 2
    phase = moving @ waves.T + rng.uniform(0, 6, len(waves))
    if kind == "spectrum":
        target = np.round((0.5 + 0.5 * np.sin(phase)) * 255).astype(np.uint8)
    elif kind == "csi":
        target = np.exp(1j * phase).astype(np.complex64)
    else:
        target = (1e-6 * 10 ** np.sin(phase)).astype(np.float32)
    ends = (moving, still) if static_end == "rx" else (still, moving)
    site = Site(
        name="toy",
        kind=kind,
        static_end=static_end,
        grid=SphereGrid.hemisphere(12, 24) if kind == "spectrum" else None,
        array=None,
        carrier_hz=1e9,
        subcarriers_hz=None,
        origin=np.array([100.0, -50.0, 3.0]),
        box=np.array([[-0.5] * 3, [0.5] * 3]),
        moving_box=np.array([[-0.5] * 3, [0.5] * 3]),
        sha256=f"{kind}-{rows}-{static_end}-{seed}",
        target_scale=2.0 if kind == "csi" else 1.0,
        static_position=still[0],
        rx_rotation=np.eye(3),
    )
    return Measurements(
        site=site,
        tx=ends[0],
        rx_position=ends[1],
        rx_rotation=np.tile(np.eye(3), (rows, 1, 1)),
        target=target.reshape(rows, *shape),
        row_names=[f"row {i}" for i in range(rows)],
    )


def divide(rows: int, folds: int = 1) -> Split:
    """Folds of every `folds`-th (or fourth) row for testing; three rows of the rest validate."""
    parts = []
    for fold in range(folds):
        test = np.arange(fold, rows, folds if folds > 1 else 4)
        rest = np.setdiff1d(np.arange(rows), test)
        parts.append(Fold(train=rest[3:], val=rest[:3], test=test))
    return Split("toy", tuple(parts))
