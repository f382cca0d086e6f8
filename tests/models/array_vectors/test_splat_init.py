"""The splatted field through an array: the posterior of the array's vectors,
and what follows from it.
"""

import numpy as np
import pytest
import torch
from campaigns import compose
from contexts import short

from gsparc.data.query import Query
from gsparc.data.splits import Fold
from gsparc.field.frozen import gaussian_vectors
from gsparc.models.array_vectors.cross_validation import choose_kernel
from gsparc.models.array_vectors.vector_cache import recover_cached
from gsparc.models.array_vectors.vector_gp import align_by_likelihood, index_mirror_elements
from gsparc.models.registry import build
from gsparc.physics.array_response import steering_matrix

COUNT = "model.field.count=64"


def _trained(data, fold, folder, *overrides: str, steps: int = 10):
    factory = build(
        compose(
            "logger=none", "model.effects.array=true", "model.effects.residual=false", *overrides
        ).model
    )
    method = factory.create_for(data)
    method.fit(data, fold, short(folder, steps, 16, validate_every=steps))
    return method


@pytest.fixture(scope="module")
def trained(known_campaign, tmp_path_factory):
    data, _ = known_campaign
    order = np.random.default_rng(0).permutation(160)
    fold = Fold(np.sort(order[60:]), order[:0], np.sort(order[:60]))
    return _trained(data, fold, tmp_path_factory.mktemp("run"), COUNT), data, fold


@pytest.fixture(scope="module")
def process(trained):
    """Mean and variance of the vector process of the same 100 spectra, at the others."""
    _, data, fold = trained
    site, places = data.site, data.tx[fold.train]
    images = data.target[fold.train].reshape(100, -1).astype(np.float32) / 255
    matrix = steering_matrix(site.array, site.grid, site.wavelength).numpy()
    partner = index_mirror_elements(site.array)
    found = recover_cached(data, fold.train)  # the same solutions
    kernel = choose_kernel(found.vectors, places, images, matrix, site.wavelength, partner).kernel
    vectors = align_by_likelihood(found.vectors, places, partner, kernel)
    rows, queries = torch.from_numpy(places), torch.from_numpy(data.tx[fold.test])
    inverse, cross = (
        np.linalg.inv(kernel.gram(rows).numpy()),
        kernel.correlations(queries, rows).numpy(),
    )
    return cross @ inverse @ vectors, 1 - np.einsum("ij,ij->i", cross @ inverse, cross)


@pytest.mark.slow
def test_the_field_is_the_posterior_of_the_vectors(trained, process):
    method, data, fold = trained
    model, batch = method.fitted_model(), data.batch(fold.test)
    mean, variance = process
    emitted = torch.view_as_complex(model.emissions(batch.tx, batch.rx).contiguous()).detach()
    vectors = (emitted @ gaussian_vectors(model, batch.rx)).numpy()
    # One phase is common to all vectors and known to nobody.
    turn = np.vdot(vectors, mean) / abs(np.vdot(vectors, mean))
    assert np.linalg.norm(vectors * turn - mean) < 2e-3 * np.linalg.norm(mean)
    np.testing.assert_allclose(
        model.unknown_shares(batch.tx, batch.rx).numpy(), variance, atol=1e-4
    )


@pytest.mark.slow
def test_a_number_of_gaussians_that_changes_nothing_was_swept_without_a_word(
    known_campaign, tmp_path
):
    """100 and 500 of them gave the same figures: more than an array needs span the same vectors."""
    data, fold = known_campaign[0], Fold(np.arange(40), np.arange(0), np.arange(40, 60))
    few, more, many = (
        _trained(data, fold, tmp_path, f"model.field.count={n}", steps=0) for n in (20, 40, 160)
    )
    query = Query(*_ends(data, fold.test))
    torch.testing.assert_close(
        more.predict(query).mean, many.predict(query).mean, rtol=0, atol=2e-3
    )
    assert (
        "through 40 Gaussians (32 or more give the same answers), no gradient steps"
    ) in more.description
    assert "alike" not in few.description


def test_a_closed_form_that_cannot_be_is_refused(known_campaign, tmp_path):
    data, _ = known_campaign
    fold = Fold(np.arange(20), np.arange(20, 24), np.arange(24, 30))
    for setting in ("emission.hidden=4", "attenuation.inverse_distance=true"):
        with pytest.raises(ValueError, match=r"asks for networks|solves a linear read-out"):
            _trained(
                data, fold, tmp_path, "init=vectors", "model.field.count=20", f"model.{setting}"
            )


def _ends(data, rows):
    batch = data.batch(rows)
    return batch.tx, batch.rx
