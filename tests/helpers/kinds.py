"""One small campaign for everything that a Gaussian field is made of."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from boxes import room_of_spectra
from campaigns import channels, powers, spectra
from known_arrays import array_site, measure, room_vectors, walk

from gsparc.data.datasets.rfid import planar_array
from gsparc.data.load import load
from gsparc.data.own import from_arrays
from gsparc.data.schema import Measurements
from gsparc.ops import SphereGrid

POSTS = np.array([[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]])


def images(folder: Path) -> Measurements:
    """Spectra of a receiver that declares no array."""
    return load({"name": "own", "file": str(spectra(folder / "images.npz"))})


def static_array(folder: Path) -> Measurements:
    """Spectra of a receiver that declares its array."""
    site = array_site(SphereGrid.hemisphere(16, 32), planar_array())
    tx = walk(60)
    return measure(site, tx, room_vectors(tx, 1, planar_array())[0], "kinds")


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
    "images": images, "static array": static_array, "moving array": moving_array, "channels": gains,
    "channels of an array": bands, "channels from nowhere known": unplaced, "powers": received,
    "powers of several stations": several,
}  # fmt: skip
