"""The Gaussian process against brute force, scikit-learn and the real data."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from releases import real
from sklearn.decomposition import PCA
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from gsparc.data.target import TARGETS
from gsparc.datasets.load import load, split_for
from gsparc.evaluation.scores import score_methods
from gsparc.models.baselines.gp import GaussianProcess, principal_components
from gsparc.training.context import FitContext


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_components_are_the_principal_ones(campaign, kind):
    target = campaign(kind, 20).target
    parts = principal_components(target, TARGETS[kind], limit=3, block=5)
    whole = principal_components(target, TARGETS[kind], limit=512)
    rows = whole.mean + whole.scores @ whole.axes
    reference = PCA(n_components=parts.scores.shape[1], svd_solver="full").fit(rows)
    assert np.allclose(parts.axes @ parts.axes.T, np.eye(len(parts.axes)), atol=1e-5)
    kept = (parts.scores**2).sum(0)
    assert np.allclose(np.sort(kept), np.sort(reference.explained_variance_ * 19), rtol=1e-4)
    left = ((rows - reference.inverse_transform(reference.transform(rows))) ** 2).mean()
    assert parts.lost == pytest.approx(left, rel=1e-3, abs=1e-9)
    assert whole.lost == pytest.approx(0, abs=1e-9)


def test_a_query_of_an_averaged_process_read_every_pixel_of_its_components(
    campaign, folds, tmp_path
):
    """Smooth images are told by few rows and columns: their numbers are read,
    thinned pixels too.
    """
    data, fold = campaign("spectrum", 40), folds(40).folds[0]
    row, column = np.ogrid[:12, :24]
    waves = [np.cos(np.pi * k * row / 12) * np.sin(np.pi * k * column / 12 + k) for k in (1, 2, 3)]
    smooth = 0.5 + np.einsum("nk,khw->nhw", np.sin(data.tx), waves) / 8
    data = replace(data, target=smooth.astype(np.float32))
    whole = GaussianProcess()
    whole.fit(data, fold, FitContext(tmp_path))
    less, batch = whole.with_strongest(1e-3), data.batch(fold.test)
    assert less.axes.shape[1] < whole.axes.shape[1] / 2
    one, other = whole.mean_at(batch), less.mean_at(batch)
    assert float((one - other).square().mean()) < 2e-3 * float(one.var(0).mean())
    again = GaussianProcess()
    again.restore(data.site, less.state())
    assert again.mean_at(batch).equal(other)
    thin = [
        each.reduce({"stride": 2, "confidence": False}, {}).inner.predict(batch)
        for each in (whole, less)
    ]
    torch.testing.assert_close(thin[1].mean, thin[0].mean, atol=0.02, rtol=0)


def test_prediction_and_variance_are_scikit_learns(campaign, folds, tmp_path):
    data, fold = campaign("csi", 40), folds(40).folds[0]
    gp = GaussianProcess()
    gp.fit(data, fold, FitContext(tmp_path))
    rows = np.concatenate([fold.train, fold.val])
    k = gp.scores.prior.kernel
    target = data.target[rows].reshape(len(rows), -1).view(np.float32)
    short, long = (
        ConstantKernel(k.amplitude * one.share) * Matern(one.length, nu=1.5) for one in k.signals
    )
    shape = short + long + WhiteKernel(k.amplitude * k.noise)
    library = GaussianProcessRegressor(shape, optimizer=None, alpha=0).fit(
        data.moving[rows], target - target.mean(0)
    )
    mean, deviation = library.predict(data.moving[fold.test], return_std=True)
    batch = data.batch(fold.test)
    found = gp.predict(batch)
    expected = torch.from_numpy(mean + target.mean(0)).float().view(-1, 4, 3, 2)
    assert torch.allclose(torch.view_as_real(found.mean), expected, atol=1e-4)
    # A complex entry holds two real numbers.
    assert torch.allclose(
        found.variance, torch.from_numpy(2 * deviation[:, 0] ** 2).float(), rtol=1e-3
    )


def test_metric_formats_on_the_real_subset(tmp_path):
    data = load({"name": "rfid", "root": str(real("rfid-s23-160"))})
    split = split_for({"name": "random"}, data)
    gp = GaussianProcess()
    gp.fit(data, split.folds[0], FitContext(tmp_path))
    figures = score_methods([gp], data, split).figures()
    assert figures["ssim_gauss"] == pytest.approx(0.927, abs=0.002)
    assert figures["psnr_db"] == pytest.approx(28.9, abs=0.2)
