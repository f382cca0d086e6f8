from functools import partial
from pathlib import Path

import numpy as np
import pytest
from refusals import refused_as
from releases import write_release

from gsparc.base.errors import DataError


@pytest.fixture
def refused():
    """`refused(says, read, ...)`: the error of `read(...)`,
    of which each problem is one short line.
    """
    return partial(refused_as, DataError)


@pytest.fixture
def write(tmp_path):
    """`write(content, name)`: a file of text, or of bytes as they are."""

    def written(content: str | bytes, name: str = "drive.csv") -> Path:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return tmp_path / name

    return written


@pytest.fixture
def rfid_folder(tmp_path) -> Path:
    """Six spectra in the release's layout."""
    return write_release(tmp_path / "release")


@pytest.fixture
def csi_arrays() -> dict[str, np.ndarray]:
    """A small valid file of one's own: static transmitter, 2 antennas, 3 subcarriers."""
    rng = np.random.default_rng(0)
    rows = 12
    return {
        "rx_position": rng.uniform(0, 3, (rows, 3)),
        "tx_position": np.array([4.0, 1.0, 2.0]),
        "csi": rng.normal(size=(rows, 2, 3)) + 1j * rng.normal(size=(rows, 2, 3)),
        "frequency_hz": np.array([2.40e9, 2.41e9, 2.42e9]),
        "array_position": np.array([[0.0, 0, 0], [0.06, 0, 0]]),
        "rx_orientation": np.array([1.0, 0, 0, 0]),
    }
