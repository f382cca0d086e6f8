"""Spectra of an array whose vectors are known: sites, paths, rooms."""

from dataclasses import replace

import numpy as np
import torch

from gsparc.data.schema import LIGHT, Measurements, Site
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import steering_matrix
from gsparc.simulate.shoebox import Room, trace_room

WAVELENGTH = 0.3259
RECEIVER = np.array([6.0, 2.0, 1.0])
TURN = np.array(
    [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
)  # boresight along -x, at the transmitters


def array_site(grid: SphereGrid, array: np.ndarray, **changes) -> Site:
    box = np.array([[1.0, 1.0, 0.8], [1.6, 2.2, 1.2]])
    site = Site(
        name="known",
        kind="spectrum",
        static_end="rx",
        grid=grid,
        array=array,
        carrier_hz=LIGHT / WAVELENGTH,
        subcarriers_hz=None,
        origin=np.zeros(3),
        box=box,
        moving_box=box,
        sha256="known",
        normalisation="max",
        static_position=RECEIVER,
        rx_rotation=TURN,
    )
    return replace(site, **changes)


def spectra(site: Site, vectors: torch.Tensor) -> torch.Tensor:
    """`|A^H h|` (B, H, W) without shortcuts:
    what `SpectrumRenderer` must equal where nothing is unknown.
    """
    array, grid, wavelength = site.array_geometry()
    matrix = steering_matrix(array, grid, wavelength).to(vectors.dtype)
    return (vectors @ matrix.conj()).abs().view(-1, grid.height, grid.width)


def measure(
    site: Site, tx: np.ndarray, vectors: np.ndarray, sha256: str = "known", bits: bool = True
) -> Measurements:
    """Published spectra of array vectors (S, M): divided by their maximum, in 8 bits."""
    image = spectra(site, torch.from_numpy(vectors)).numpy()
    image = image / image.max((1, 2), keepdims=True)
    rows = len(tx)
    return Measurements(
        site=replace(site, sha256=sha256),
        tx=tx,
        rx_position=np.tile(RECEIVER, (rows, 1)),
        rx_rotation=np.tile(TURN, (rows, 1, 1)),
        target=np.round(255 * image).astype(np.uint8) if bits else image.astype(np.float32),
        row_names=[f"row {i}" for i in range(rows)],
    )


def walk(rows: int, seed: int = 0, step: float = 0.012) -> np.ndarray:
    """A smooth path (rows, 3) [m] in front of the receiver."""
    rng = np.random.default_rng(seed)
    angle = np.cumsum(rng.normal(0, 0.12, rows))
    moves = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(2 * angle)], 1) * step
    return np.array([1.3, 1.6, 1.0]) + np.cumsum(moves, 0) - np.cumsum(moves, 0).mean(0)


def room_vectors(tx: np.ndarray, order: int, array: np.ndarray):
    """Array vectors (S, M) of a traced room and the trace."""
    room = Room.from_size((7.0, 5.0, 3.0), -0.6)
    traced = trace_room(
        room, tx, RECEIVER, LIGHT / WAVELENGTH, max_order=order, array=array @ TURN.T
    )
    return traced.csi[:, :, 0], traced
