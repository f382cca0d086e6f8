from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsparc.data.rfid import HEIGHT, WIDTH

SHARED = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"


def _real(name: str) -> Path:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"real data not found at ../shared/data/{name}")
    return path


@pytest.fixture
def real_rfid() -> Path:
    return _real("rfid-s23-160")


@pytest.fixture
def real_newrf() -> Path:
    return _real("newrf-conference.npz")


@pytest.fixture
def rfid_folder(tmp_path) -> Path:
    """Six spectra in the release's layout."""
    root = tmp_path / "release"
    (root / "spectrum").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for i in range(1, 7):
        image = Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8))
        image.save(root / "spectrum" / f"{i:05d}.png", compress_level=1)
    (root / "gateway_info.yml").write_text(
        "dataset_name: s23\n"
        "gateway1:\n  position: [5.0, 0.26, 0]\n"
        "  orientation: [0.51291602, -0.48674136, -0.48674136, 0.51291602]\n"
        "gateway2:\n  position: [0, 0, 2]\n  orientation: [0, 0, 0, 1]\n"
    )
    rows = "".join(f"{0.1 * i:.4f},0.2000,1.0000\n" for i in range(6))
    (root / "tx_pos.csv").write_text("x,y,z\n" + rows)
    (root / "train_index.txt").write_text("00001\n00003\n00004\n00006\n")
    (root / "test_index.txt").write_text("00002\n00005\n")
    return root


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


@pytest.fixture
def spectrum_arrays() -> dict[str, np.ndarray]:
    """A small valid file of one's own: static receiver, images of 9 x 36."""
    rng = np.random.default_rng(0)
    return {
        "rx_position": np.array([4.0, 1.0, 2.0]),
        "tx_position": rng.uniform(0, 3, (10, 3)),
        "spectrum": rng.uniform(0, 1, (10, 9, 36)),
    }
