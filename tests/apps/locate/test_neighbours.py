"""Nearest rows place features, tell silence from levels, and do as published."""

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from releases import real

from gsparc.apps.locate.judging import fingerprint_snapshots, report
from gsparc.apps.locate.neighbours import PLAIN, _count, feature_vectors, locate_by_neighbours
from gsparc.apps.locate.snapshots import Scans
from gsparc.datasets.fingerprints import read_fingerprints, split_fingerprints


def hall(count, seed):
    """Eight smooth features of a hall of 10 x 8 m, the smallest ones silent."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 1, (count, 3)) * [10, 8, 0]
    apart = np.linalg.norm(
        places[:, None, :2] - np.random.default_rng(5).uniform(0, 1, (8, 2)) * [10, 8], axis=2
    )
    levels = -40 - 5 * apart + rng.normal(0, 1, apart.shape)
    return heard(np.where(levels > -75, levels, np.nan), places)


def heard(values, places):
    kind = "csi" if np.iscomplexobj(values) else "rssi"
    return Scans(kind, torch.from_numpy(values), None, places)


@pytest.mark.parametrize("name", PLAIN)
def test_a_hall_is_learned_also_from_two_rows(name):
    known, asked = hall(300, 0), hall(100, 1)
    place, each_ms, fit_s = locate_by_neighbours(name, known, asked)
    assert (
        np.median(np.linalg.norm(place - asked.place, axis=1)) < 1.2 and each_ms > 0 and fit_s > 0
    )
    assert np.isfinite(locate_by_neighbours(name, known.subset(np.arange(2)), asked)[0]).all()
    silent = heard(np.full((4, 8), np.nan), known.place[:4])
    with pytest.raises(ValueError, match="no row that could be learned from holds a value"):
        locate_by_neighbours(name, silent, asked)


def test_one_neighbour_was_chosen_by_places_that_lie_between_others():
    """Of a drive tested in gaps the nearest row had 300 m, three to nine rows 200 to 218."""
    rng = np.random.default_rng(0)
    squares = np.repeat(np.stack(np.meshgrid(range(6), range(6)), -1).reshape(-1, 2) * 10.0, 4, 0)
    places = np.c_[squares + rng.normal(0, 0.3, squares.shape), np.zeros(len(squares))]
    posts = rng.uniform(0, 50, (12, 2))
    level = -np.linalg.norm(places[:, None, :2] - posts, axis=2)
    # What places of a square share, as shadowing, tells of no other square.
    level += np.repeat(rng.normal(0, 8, (36, 12)), 4, 0)
    square = np.repeat(np.arange(36), 4) % 5
    counts = [_count(PLAIN["weighted_knn"], level, places, group) for group in (None, square)]
    assert counts[0] <= 3 < counts[1]


def test_a_table_was_called_as_the_trained_file(tmp_path):
    """Of `data=sec40.csv` the table said `drive`, the file that was learned from."""
    known, columns = hall(20, 0), {"error_m": np.ones(20)}
    config = OmegaConf.create({"data": "logs/sec40.csv", "against": []})
    facts = {"dataset/name": "drive"}
    _, tables, _ = report(tmp_path, config, "gp", known, known, columns, facts)
    assert tables[0].title == "sec40, 20 snapshots"


def test_silence_tells_rooms_apart():
    known = heard(
        np.array([[-50, np.nan], [-50, -60.0]] * 4), np.array([[0.0, 0, 0], [9.0, 0, 0]] * 4)
    )
    np.testing.assert_allclose(locate_by_neighbours("nearest", known, known)[0], known.place)


def test_a_phase_of_a_whole_channel_is_no_feature():
    values = np.exp(1j * np.arange(6.0)).reshape(2, 3)
    places = np.zeros((2, 3))
    turned = feature_vectors(heard(values * np.exp(0.7j), places))
    np.testing.assert_allclose(turned, feature_vectors(heard(values, places)), atol=1e-12)


def test_weighted_neighbours_do_as_published_on_a_floor():
    """1.5 m is known of five neighbours."""
    rows = read_fingerprints(real("locate/wifine-floor4.npz"))
    train, test = split_fingerprints(rows, "walks", share=0.25)
    known, heard = (fingerprint_snapshots(rows.subset(part)) for part in (train, test))
    place, *_ = locate_by_neighbours("weighted_knn", known, heard)
    assert 0.9 < np.median(np.linalg.norm(place - rows.position[test], axis=1)) < 1.6
