"""The static-array model end to end: renderer, Gaussian process, kernel choice, state, queries."""

import numpy as np
import pytest
import torch
from known_arrays import array_site, measure, spectra, walk
from releases import real

from gsparc.data.splits import Fold
from gsparc.datasets.load import load, split_for
from gsparc.datasets.rfid import planar_array
from gsparc.evaluation.scores import score_methods
from gsparc.field.gaussians import FieldSettings
from gsparc.models.array_vectors.vector_gp import (
    align_by_likelihood,
    index_mirror_elements,
    refine_alignment,
    twin_vectors,
)
from gsparc.models.registry import method_class
from gsparc.models.splat.array import ArrayField
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import steering_matrix
from gsparc.physics.bartlett import SpectrumRenderer
from gsparc.processes.kernel import Kernel, SmoothRough
from gsparc.training.context import FitContext

SMALL = FieldSettings(count=64)


def _fold(rows):
    order = np.random.default_rng(0).permutation(rows)
    cut = rows // 5
    return Fold(np.sort(order[2 * cut :]), np.sort(order[cut : 2 * cut]), np.sort(order[:cut]))


@pytest.mark.parametrize(
    "grid", [SphereGrid.hemisphere(6, 10), SphereGrid(5, 7, 0.1, 0.3, 0.2, 0.4)]
)
@pytest.mark.parametrize("height", [0.0, 0.07])
def test_renderer_equals_the_plain_beamformer(grid, height):
    """With and without the half-turn shortcut: on any grid,
    and with an element out of the plane [m].
    """
    array = planar_array()
    array[3, 2] = height
    rng = np.random.default_rng(0)
    site, background = (
        array_site(grid, array),
        torch.from_numpy(rng.random((grid.height, grid.width))),
    )
    h = torch.from_numpy(rng.normal(size=(3, 16)) + 1j * rng.normal(size=(3, 16))) / 30
    share = torch.tensor([[0.0], [0.5], [1.0]], dtype=torch.float64)
    expected = (spectra(site, h).square() + share[:, :, None].square() * background.square()).sqrt()
    renderer = SpectrumRenderer(*site.array_geometry(), background)
    extended = torch.cat([h, share.to(h.dtype)], 1).to(torch.complex64)
    assert renderer.half_turn == (grid.width == 10 and height == 0)
    torch.testing.assert_close(renderer(extended).double(), expected, atol=2e-4, rtol=1e-4)


def test_renderer_gradient():
    site = array_site(SphereGrid.hemisphere(4, 6), planar_array(2, 2))
    renderer = SpectrumRenderer(*site.array_geometry(), torch.rand(4, 6)).double()
    h = torch.randn(2, 5, dtype=torch.complex128)
    real = torch.view_as_real(h).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: renderer(torch.view_as_complex(v)), [real])


def test_alignment_undoes_phases_and_twins(known_campaign):
    """Scrambled vectors of a smooth field predict each other again."""
    data, truth = known_campaign
    partner, rng = index_mirror_elements(data.site.array), np.random.default_rng(1)
    scale = truth / np.linalg.norm(truth, axis=1, keepdims=True)
    seen, twins = (
        spectra(data.site, torch.from_numpy(v)) for v in (scale, twin_vectors(scale, partner))
    )
    torch.testing.assert_close(seen, twins)
    mixed = scale * np.exp(2j * np.pi * rng.random(160))[:, None]
    mixed[::3] = twin_vectors(mixed[::3], partner)
    kernel = Kernel.from_length(0.2, 1e-3, term=SmoothRough)
    inverse = np.linalg.inv(kernel.gram(torch.from_numpy(data.tx)).numpy())
    vectors = align_by_likelihood(mixed, data.tx, partner, kernel)
    left_out = vectors - (inverse @ vectors) / np.diag(inverse)[:, None]
    overlap = np.abs((left_out.conj() * vectors).sum(1)) / np.linalg.norm(left_out, axis=1)
    assert np.median(overlap) > 0.99
    assert np.allclose(refine_alignment(vectors, inverse, partner, 1), vectors, atol=0.02)
    assert partner.tolist() == list(range(15, -1, -1))
    assert index_mirror_elements(np.array([[0.0, 0, 0], [0.16, 0, 0], [0.48, 0, 0]])) is None


def test_cross_validation_with_gaps_equals_refitting(known_campaign):
    """The block formula gives what a process fitted without those samples gives."""
    from gsparc.models.array_vectors import cross_validation

    data, truth = known_campaign
    x, v = data.tx[:30], truth[:30] / np.linalg.norm(truth[:30], axis=1, keepdims=True)
    kernel, at = Kernel.from_length(0.15, 0.01, term=SmoothRough), torch.from_numpy(x)
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    matrix = steering_matrix(data.site.array, data.site.grid, data.site.wavelength).numpy()[:, :50]
    samples = cross_validation._Samples(
        np.zeros((30, 50)), matrix.conj(), np.zeros(50), np.array([7]), np.array([0.03]), distance
    )
    unknown, predicted = samples.predict(kernel, np.linalg.inv(kernel.gram(at).numpy()), v)
    error = samples.squared_errors(predicted)
    far = distance[7] > 0.03
    cross = kernel.correlations(at[far], at[7:8]).numpy()
    weights = np.linalg.solve(kernel.gram(at[far]).numpy(), cross)[:, 0]
    assert unknown[0, 0] == pytest.approx(1 - weights @ cross[:, 0], rel=1e-6)
    assert error[0, 0] == pytest.approx(
        (np.abs((weights @ v[far]) @ matrix.conj()) ** 2).mean(), rel=1e-6
    )


def test_fit_without_a_run_folder_writes_nothing(known_campaign, tmp_path, monkeypatch):
    """`gsparc.fit` left array_recovery.csv where it was called."""
    monkeypatch.chdir(tmp_path)
    ArrayField(SMALL).fit(known_campaign[0], _fold(160), FitContext())
    assert not list(tmp_path.iterdir())


def test_antennas_at_one_place_are_refused(tmp_path):
    """A Fourier transform of no lags ended in the library's words."""
    site = array_site(SphereGrid.hemisphere(4, 6), np.zeros((4, 3)))
    data = measure(site, walk(12), np.ones((12, 4), complex))
    with pytest.raises(ValueError, match="all antennas of the declared array are at one place"):
        ArrayField(SMALL).fit(data, _fold(12), FitContext(tmp_path))


@pytest.mark.slow
def test_level_with_the_gp_on_random_and_ahead_on_grouped(tmp_path):
    """Real spectra: paired differences to the image GP."""
    data = load({"name": "rfid", "root": str(real("rfid-s23-160"))})
    ahead = {}
    for name in ("random", "grouped"):
        split = split_for({"name": name}, data)
        scores = []
        for kind in (ArrayField, method_class("gp")):
            methods = [kind() for _ in split.folds]
            for method, fold in zip(methods, split.folds, strict=True):
                method.fit(data, fold, FitContext(tmp_path))
            scores.append(score_methods(methods, data, split))
        ahead[name] = [
            (scores[0].samples[k] - scores[1].samples[k]).mean() for k in ("ssim_gauss", "psnr_db")
        ]
    assert ahead["random"][0] > 0 and ahead["random"][1] > 0
    assert ahead["grouped"][0] > 0.01 and ahead["grouped"][1] > 0.2
