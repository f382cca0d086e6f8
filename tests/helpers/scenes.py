"""Small scenes in which one idea must work and another cannot."""

from typing import Any

import numpy as np
import torch
from campaigns import spectra
from shoeboxes import as_arrays, scatter

from gsparc.data.query import Query
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.load import split_for
from gsparc.ops import SphereGrid
from gsparc.simulate.shoebox import Room, trace_room
from gsparc.tables.own import from_arrays, load_own


def fold_of(data: Measurements, **split: Any) -> Fold:
    """The first fold of a split, `random` unless said."""
    return split_for({"name": "random", **split}, data).folds[0]


def lobes(path, moving: str = "tx") -> tuple[Measurements, Fold]:
    """Six fixed lobes whose strengths come and go with the position."""
    data = load_own(spectra(path / "lobes.npz", rows=60, moving=moving))
    return data, fold_of(data)


def wandering(rows: int = 60) -> tuple[Measurements, Fold]:
    """One lobe, 35 degrees wide, that follows the transmitter:
    interpolation of brightness shows two.
    """
    rng = np.random.default_rng(0)
    where = rng.uniform(-1, 1, (rows, 3)) * [1, 1, 0] + [0, 0, 1.0]
    directions = SphereGrid.hemisphere(16, 32).directions().numpy()
    towards = where / np.linalg.norm(where, axis=1, keepdims=True)
    image = np.exp(6 * (np.einsum("hwc,sc->shw", directions, towards) - 1)).astype(np.float32)
    data = from_arrays({"spectrum": image, "tx_position": where, "rx_position": np.zeros(3)})
    return data, fold_of(data)


def room(
    rows: int = 120, frequency_hz: float = 3e8, max_order: int = 1, directions: bool = False
) -> tuple[Measurements, Fold, np.ndarray]:
    """Channels in a 4 x 3 x 2.5 m box of mirrors, with its sources (I, 3);
    a wavelength of 1 m at 300 MHz.
    """
    box = Room.from_size((4.0, 3.0, 2.5), -0.6)
    told = trace_room(
        box,
        np.array([0.7, 0.8, 1.9]),
        scatter(box, rows, seed=1, margin=0.3),
        frequency_hz,
        max_order=max_order,
        snr_db=40,
    )
    arrays = as_arrays(told)
    sources = told.images.mirror_points(told.tx[0])
    if directions:
        paths = (sources[None] - told.rx[:, None]).reshape(-1, 3)
        arrays["path_direction"] = paths / np.linalg.norm(paths, axis=1, keepdims=True)
        arrays["path_offsets"] = len(sources) * np.arange(rows + 1)
    data = from_arrays(arrays)
    return data, fold_of(data), sources - data.site.origin


def shadowed(
    rows: int = 200, range_m: float = 2.0, noise_db: float = 0.5
) -> tuple[Measurements, Fold]:
    """Power with shadowing of 6 dB that is correlated as exp(-distance / range), over 20 x 20 m."""
    rng = np.random.default_rng(0)
    where = np.column_stack([rng.uniform(0, 20, (rows, 2)), np.full(rows, 1.5)])
    apart = np.linalg.norm(where[:, None] - where[None], axis=-1)
    drawn = np.linalg.cholesky(36 * np.exp(-apart / range_m) + 1e-9 * np.eye(rows)) @ rng.normal(
        size=rows
    )
    power = -60 + drawn + noise_db * rng.normal(size=rows)
    data = from_arrays(
        {"rssi_db": power, "rx_position": where, "tx_position": np.array([10.0, 10.0, 5.0])}
    )
    return data, fold_of(data)


def error(method, data: Measurements, rows: np.ndarray) -> float:
    """sum |e|^2 / sum |target|^2 on the rows, asked at their places alone."""
    batch = data.batch(rows)
    return _share(method.predict(Query(batch.tx, batch.rx)).mean, batch.target)


def answer_error(model, data: Measurements, rows: np.ndarray) -> float:
    """The same of a method's or a field's answers to rows, in the phase of their runs."""
    batch = data.batch(rows)
    with torch.no_grad():
        return _share(model.predict(batch).mean, batch.target)


def _share(mean: torch.Tensor, target: torch.Tensor) -> float:
    return float((mean - target).abs().square().sum() / target.abs().square().sum())
