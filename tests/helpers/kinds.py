"""One small campaign for everything that a Gaussian field is made of."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from boxes import room_of_spectra
from campaigns import channels, powers, spectra
from known_arrays import array_site, measure, room_vectors, walk

from gsparc.data.schema import Measurements
from gsparc.datasets.load import load
from gsparc.datasets.rfid import planar_array
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import bartlett_spectrum, steering_matrix
from gsparc.tables.own import from_arrays

CARRIERS, PLACES, WALL, CEILING = 5, 30, 4.0, 3.0
HERTZ = np.array([1.0, 2.0, 5.0, 20.0, 60.0]) * 1e9
ELEMENTS = planar_array(spacing_m=0.5)[:, [2, 0, 1]]  # in wavelengths, in the plane yz
POSTS = np.array([[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]])


def images(folder: Path) -> Measurements:
    """Spectra of a receiver that declares no array."""
    return load({"name": "own", "file": str(spectra(folder / "images.npz"))})


def static_array(folder: Path) -> Measurements:
    """Spectra of a receiver that declares its array."""
    site = array_site(SphereGrid.hemisphere(16, 32), planar_array())
    tx = walk(60)
    return measure(site, tx, room_vectors(tx, 1, planar_array())[0], "kinds")


def carriers(folder: Path | None = None) -> Measurements:
    """Places in sight of an array, a mirror at y = 4 and one at z = 3; phases of paths free."""
    rng, grid, elements = np.random.default_rng(0), SphereGrid.hemisphere(24, 48), ELEMENTS
    place = np.c_[
        rng.uniform(2, 6, PLACES), rng.uniform(-3, 3, PLACES), rng.uniform(0.8, 1.6, PLACES)
    ]
    images = [
        place,
        place * [1, -1, 1] + [0, 2 * WALL, 0],
        place * [1, 1, -1] + [0, 0, 2 * CEILING],
    ]
    away = np.stack(images, 1) - [0.0, 0.0, 1.0]
    distance = np.linalg.norm(away, axis=2)
    response = np.exp(2j * np.pi * away / distance[..., None] @ elements.T)
    gains = (
        np.array([1, 0.8, 0.7]) / distance * np.exp(2j * np.pi * rng.random((CARRIERS, PLACES, 3)))
    )
    vectors = np.einsum("cpk,pkm->pcm", gains, response).reshape(-1, 16)
    spectra = bartlett_spectrum(
        torch.from_numpy(vectors), steering_matrix(elements, grid, 1.0)
    ).numpy()
    spectra = (spectra / spectra.max(1, keepdims=True)).reshape(-1, 24, 48)
    station = np.tile(np.arange(CARRIERS), PLACES)
    arrays = {
        "tx_position": np.repeat(place, CARRIERS, axis=0),
        "rx_position": np.array([0.0, 0.0, 1.0]),
        "spectrum": spectra,
        "carrier_hz": HERTZ[station],
        "array_position": elements * 0.3,
    }
    data = from_arrays(arrays, {"normalisation": "max"})
    # An array half a wavelength apart at each carrier.
    alike = elements * (299_792_458.0 / HERTZ)[:, None, None]
    object.__setattr__(data.site.stations, "array", alike)
    return data


def moving_array(folder: Path) -> Measurements:
    """Spectra of an array that moves."""
    return room_of_spectra()


def gains(folder: Path) -> Measurements:
    """One channel of a carrier per place."""
    return load({"name": "own", "file": str(channels(folder / "gains.npz", shape="S"))})


def bands(folder: Path) -> Measurements:
    """Two antennas, two tones, a transmitter that moves."""
    return load({"name": "own", "file": str(channels(folder / "bands.npz", moving="tx"))})


def unplaced(folder: Path) -> Measurements:
    """Channels of a station at a place that nobody knows."""
    data = gains(folder)
    return replace(data, site=replace(data.site, static_position=None))


def received(folder: Path) -> Measurements:
    """Powers of one station."""
    return load({"name": "own", "file": str(powers(folder / "powers.npz"))})


def several(folder: Path) -> Measurements:
    """Powers of two stations."""
    rng = np.random.default_rng(0)
    places = rng.uniform([0, 0, 1], [20, 20, 2], (60, 3))
    far = np.linalg.norm(places[:, None] - POSTS, axis=-1)
    decibels = -20 * np.log10(far) + rng.normal(size=far.shape)
    return from_arrays({"tx_position": places, "station_position": POSTS, "rssi_db": decibels})


KINDS: dict[str, Callable[[Path], Measurements]] = {
    "images": images,
    "static array": static_array,
    "moving array": moving_array,
    "channels": gains,
    "channels of an array": bands,
    "channels from nowhere known": unplaced,
    "powers": received,
    "powers of several stations": several,
}
