"""The encoder: blind to what is the snapshot's own, and nearer the truth than a guess."""

import numpy as np
from cities import city, fold
from scipy.spatial import cKDTree

from gsparc.data.position_encoder import encode_positions, features


def test_features_do_not_see_phase_and_timing() -> None:
    uplink = city().uplink[:8].astype(np.complex128)
    turned = uplink * np.exp(1j * (0.7 - 0.3 * np.arange(26)))
    assert np.allclose(features(turned), features(uplink), atol=1e-4)
    assert not np.allclose(features(2 * uplink), features(uplink), atol=1e-2)


def test_codes_know_more_of_the_place_than_chance() -> None:
    """By training rows alone: what other rows hold changes none."""
    data, rows = city(), fold()
    codes = encode_positions(data.uplink, rows.train)
    test, truth = np.concatenate([rows.val, rows.test]), data.moving
    near = cKDTree(codes[rows.train]).query(codes[test], k=3)[1]
    located, guessed = truth[rows.train][near].mean(1), truth[rows.train].mean(0)
    errors = [np.median(np.linalg.norm(at - truth[test], axis=1)) for at in (located, guessed)]
    assert errors[0] < errors[1]
    other = data.uplink.copy()
    other[test] *= 3
    np.testing.assert_array_equal(
        encode_positions(other, rows.train)[rows.train], codes[rows.train]
    )
