import hashlib

import numpy as np
from poses import boresight_degrees

from gsparc.datasets.rfid import load_rfid
from gsparc.simulate.rfid_sim import RFIDStandIn


def _digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return [(p.name, hashlib.sha256(p.read_bytes()).hexdigest()) for p in files]


def test_deterministic_by_seed_and_reused(tmp_path):
    first = RFIDStandIn(20, 3, tmp_path / "a").folder()
    other = RFIDStandIn(20, 3, tmp_path / "b").folder()
    assert _digest(first) == _digest(other)
    assert _digest(first) != _digest(RFIDStandIn(20, 4, tmp_path / "a").folder())
    stamp = (first / "tx_pos.csv").stat().st_mtime_ns
    assert RFIDStandIn(20, 3, tmp_path / "a").folder() == first
    assert (first / "tx_pos.csv").stat().st_mtime_ns == stamp
    assert [p.name for p in (tmp_path / "b").iterdir()] == ["rfid-sim-20-3"]


def test_never_passes_for_the_release(tmp_path):
    data = load_rfid(RFIDStandIn(20, 0, tmp_path).folder())
    assert data.site.name == "rfid-sim" and data.site.stand_in == "rfid"
    assert data.target.max(axis=(1, 2)).min() == 255
    assert [len(part) for part in data.release_split] == [16, 4]


def test_tags_sit_on_bright_pixels_like_the_real_ones(tmp_path):
    data = load_rfid(RFIDStandIn(60, 0, tmp_path).folder())
    elevation, azimuth = boresight_degrees(data)
    assert elevation.min() > 75 and elevation.max() < 81
    pixel = data.target[
        np.arange(60), np.round(elevation).astype(int), np.round(azimuth).astype(int) % 360
    ]
    assert pixel.mean() / 255 > 0.6 and 0.3 < data.target.mean() / 255 < 0.5
