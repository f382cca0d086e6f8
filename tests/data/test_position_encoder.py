"""The encoder: blind to what is the snapshot's own, spread out, frozen, and nearer the truth than a guess."""

import numpy as np
import pytest
import torch
from cities import city, fold
from scipy.spatial import cKDTree

from gsparc.data.errors import DataError
from gsparc.data.position_encoder import EncoderSettings, encoder_for, features, load, places, spread

QUICK = EncoderSettings(hidden=32, steps=150, batch=64)


def test_features_do_not_see_phase_and_timing() -> None:
    uplink = city().uplink[:8].astype(np.complex128)
    turned = uplink * np.exp(1j * (0.7 - 0.3 * np.arange(26)))
    assert np.allclose(features(turned), features(uplink), atol=1e-4)
    assert not np.allclose(features(2 * uplink), features(uplink), atol=1e-2)


def test_spread_rewards_distance() -> None:
    codes = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    assert spread(2 * codes) < spread(codes)


def test_trained_once_and_read_back(tmp_path) -> None:
    uplink, rows = city().uplink, fold().train
    encode = encoder_for(tmp_path, QUICK)
    first = encode(uplink, rows)
    (file,) = tmp_path.glob("*.pt")
    stamp = file.stat().st_mtime_ns
    assert np.array_equal(encode(uplink, rows), first) and file.stat().st_mtime_ns == stamp
    assert np.array_equal(encoder_for(tmp_path, EncoderSettings(), file)(uplink, rows), first)
    assert not any(p.requires_grad for p in load(file).parameters())
    with pytest.raises(DataError, match="features"):
        places(load(file), uplink[:, :8])


def test_a_damaged_file_is_refused(tmp_path) -> None:
    (tmp_path / "x.pt").write_bytes(b"nothing")
    with pytest.raises(DataError, match="not a gsparc encoder"):
        load(tmp_path / "x.pt")
    with pytest.raises(DataError, match="no such encoder"):
        load(tmp_path / "y.pt")


def test_codes_know_more_of_the_place_than_chance(tmp_path) -> None:
    data, rows = city(), fold()
    codes = encoder_for(tmp_path, QUICK)(data.uplink, rows.train)
    test, truth = np.concatenate([rows.val, rows.test]), data.moving
    near = cKDTree(codes[rows.train]).query(codes[test], k=3)[1]
    located, guessed = truth[rows.train][near].mean(1), truth[rows.train].mean(0)
    errors = [np.median(np.linalg.norm(at - truth[test], axis=1)) for at in (located, guessed)]
    assert errors[0] < errors[1]
