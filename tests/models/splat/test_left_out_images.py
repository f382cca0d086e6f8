"""Images predicted without their neighbours are what a fit without these rows predicts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from gsparc.models.splat.left_out_images import LeftOut
from gsparc.processes.fit_kernel import choose_left_out_kernel

COUNT, PIXELS = 30, 12


@pytest.fixture(scope="module")
def left() -> LeftOut:
    draws = np.random.default_rng(0)
    places = np.c_[draws.uniform(0, 1, (COUNT, 2)), np.zeros(COUNT)]
    images = np.sin(places @ draws.normal(0, 4, (3, PIXELS))) / 3 + 0.5
    gaps, centres = np.array([0.0, 0.2, 5.0]), np.array([3, 11, 20])
    return LeftOut(places, images, centres, gaps, np.zeros((3, 3, PIXELS)))


def test_the_process_has_not_seen_what_lies_within_the_gap(left):
    found = left.predict_by_process()
    mean, at = left.images.mean(0), torch.from_numpy(left.positions)
    vectors, lengths, _ = np.linalg.svd(left.images - mean, full_matrices=False)
    kernel = choose_left_out_kernel(left.positions, vectors * lengths, PIXELS)
    for g, c in [(0, 0), (1, 1), (1, 2)]:
        i = left.centres[c]
        far = np.linalg.norm(left.positions - left.positions[i], axis=1) > left.gaps[g]
        weights = np.linalg.solve(kernel.gram(at[far]).numpy(), left.images[far] - mean)
        wanted = mean + kernel.correlations(at[[i]], at[far])[0].numpy() @ weights
        assert np.allclose(found[g, c], wanted, atol=1e-6)
    assert np.isnan(found[2]).all()  # nothing lies beyond 5 m
    assert len(left.beside_process(None)[0]) == 3
    assert (
        len(replace(left, gaps=left.gaps[2:], predicted=left.predicted[2:]).beside_process(None)[0])
        == 0
    )


def test_the_gap_is_as_wide_as_held_out_rows_are_far(left):
    apart = cdist(left.positions, left.positions)
    np.fill_diagonal(apart, np.inf)
    assert left.nearest_gap(float(np.median(apart[left.centres].min(1)))) == 0
    assert left.nearest_gap(0.25) == 1 and left.nearest_gap(None) == 0
