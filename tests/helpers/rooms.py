"""Rooms of the image-source simulator whose every source is known, as measurements."""

from dataclasses import replace

import numpy as np
from shoeboxes import as_arrays, scatter

from gsparc.data.schema import Measurements
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold, make_split
from gsparc.simulate.shoebox import Room, Trace, trace_room
from gsparc.tables.own import from_arrays

WAVELENGTH = 299_792_458.0 / 2.4e9
PILLAR = np.array([[[1.6, 1.2, 0.0], [2.0, 1.6, 2.5]]])


def shoebox(
    count: int,
    *,
    size: tuple[float, float, float] = (4.0, 3.0, 2.5),
    reflection: complex = -0.7,
    pillar: bool = False,
    frequency_hz: np.ndarray | float = 2.4e9,
    max_order: int = 2,
    array: np.ndarray | None = None,
    snr_db: float = 30.0,
    seed: int = 0,
) -> tuple[Trace, Measurements, Fold]:
    """A transmitter near a corner, `count` receivers all over the room; its trace,
    data and random fold.
    """
    room = Room.from_size(size, reflection, occluders=PILLAR if pillar else np.zeros((0, 2, 3)))
    tx = np.array(size) * [0.15, 0.27, 0.75]
    rx = scatter(room, count, seed + 1, margin=0.1)
    told = trace_room(
        room, tx, rx, frequency_hz, max_order=max_order, array=array, snr_db=snr_db, seed=seed
    )
    data = from_arrays(as_arrays(told))
    return told, data, make_split(data.moving, SplitSettings(seed=seed)).folds[0]


def directed(
    count: int,
    *,
    pillar: bool = False,
    tones: int = 1,
    array: np.ndarray | None = None,
    seed: int = 0,
) -> tuple[Measurements, Fold, np.ndarray]:
    """A shoebox whose receivers measured where every visible path comes from,
    and its sources (7, 3) [m].
    """
    comb = 2.4e9 + 1e6 * np.arange(tones)
    trace, data, fold = shoebox(
        count,
        pillar=pillar,
        frequency_hz=comb if tones > 1 else 2.4e9,
        max_order=1,
        array=array,
        seed=seed,
    )
    sources = trace.images.mirror_points(trace.tx[0])
    rays = sources[None] - trace.rx[:, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    seen = [rays[i][trace.visible[i]].astype(np.float32) for i in range(count)]
    return replace(data, directions=seen), fold, sources - data.site.origin


def nmse(predicted: np.ndarray, true: np.ndarray) -> float:
    """sum |e|^2 / sum |h|^2."""
    return float((np.abs(predicted - true) ** 2).sum() / (np.abs(true) ** 2).sum())
