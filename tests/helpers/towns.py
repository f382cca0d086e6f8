"""A town with two stations whose powers are a distance law and shadowing, and a model of it."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from campaigns import compose
from scipy.linalg import cholesky
from scipy.spatial.distance import cdist

import gsparc
from gsparc.commands.train import train
from gsparc.data.georeference import Georeference
from gsparc.prediction.predictor import Predictor

MASTS = np.array([[10.0, 20, 8], [70, 45, 8]])
SIDE = (80.0, 60.0)
ORIGIN = Georeference(47.2, 11.3)


def town_file(path: Path, rows: int = 300, seed: int = 0) -> Path:
    """Powers [dBm] over 80 x 60 m at 1.5 m, shadowing of 5 dB over 15 m, 1 dB of noise."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(0, 1, (rows, 2)) * SIDE, np.full(rows, 1.5)])
    root = cholesky(np.exp(-cdist(place, place) / 15) + 1e-6 * np.eye(rows), lower=True)
    loss = 30 * np.log10(cdist(place, MASTS))
    power = -30 - loss + 5 * root @ rng.normal(size=(rows, 2)) + rng.normal(size=(rows, 2))
    np.savez(
        path,
        rx_position=place,
        station_position=MASTS,
        station_name=np.array(["west", "east"]),
        rssi_db=power,
    )
    return path


@cache
def town_model() -> Path:
    """A checkpoint of `gp` on half of the town's blocks."""
    return trained(town_file(Path(mkdtemp()) / "town.npz"), "gp", "split=random", "threads=1")


def trained(file: Path, model: str, *more: str) -> Path:
    """The checkpoint of a model of one's own measurements, beside their file."""
    own = ("dataset=own", f"dataset.file='{file}'", f"model={model}", "baselines=[]", "logger=none")
    train(compose(*own, *more), file.parent)
    return file.parent / "model.ckpt"


def town_on_earth() -> Predictor:
    """The town's model, which knows its place on Earth."""
    predictor = gsparc.load(town_model())
    predictor.site = replace(predictor.site, georeference=ORIGIN)
    return predictor
