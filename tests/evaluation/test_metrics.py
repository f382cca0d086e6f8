"""Figures of merit against their definitions and against hard cases;
how they are shown and compared.
"""

import math
from typing import get_args

import numpy as np
import pytest
import torch
from refusals import refused
from skimage.metrics import structural_similarity

from gsparc.data.schema import Scored
from gsparc.evaluation.metric_formats import (
    DECIDING,
    FIGURES,
    OF_KIND,
    lower_is_better,
    score_heading,
    score_of,
)
from gsparc.evaluation.metrics import (
    ChannelMetrics,
    PowerMetrics,
    SpectrumMetrics,
)


def spectra(count: int = 3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(count, 20, 30, generator=generator)
    return (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def channels(count: int = 5, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.randn(count, 4, 6, dtype=torch.complex64, generator=generator)
    return target + 0.3 * torch.randn(
        target.shape, dtype=torch.complex64, generator=generator
    ), target


def summarise(metric, *arguments):
    metric.update(*arguments)
    return metric.summary(metric.compute())


def test_spectrum_figures_are_the_libraries():
    prediction, target = spectra()
    figures = summarise(SpectrumMetrics(), prediction, target)
    p, t = prediction.double().numpy(), target.double().numpy()
    plain = [
        structural_similarity(a, b, win_size=7, data_range=1.0) for a, b in zip(p, t, strict=True)
    ]
    gauss = [
        structural_similarity(
            a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        )
        for a, b in zip(p, t, strict=True)
    ]
    mse = ((p - t) ** 2).mean((1, 2))
    assert figures["ssim"] == pytest.approx(np.mean(plain), abs=1e-12)
    assert figures["ssim_median"] == pytest.approx(np.median(plain), abs=1e-12)
    assert figures["ssim_gauss"] == pytest.approx(np.mean(gauss), abs=1e-12)
    assert figures["psnr_db"] == pytest.approx(np.mean(-10 * np.log10(mse)), abs=1e-9)
    assert figures["mae"] == pytest.approx(np.abs(p - t).mean(), abs=1e-12)
    assert figures["nmse"] == pytest.approx(((p - t) ** 2).sum() / (t**2).sum(), abs=1e-12)


@pytest.mark.parametrize("scale", [1e-200, 1e-120, 1e-90, 1e90, 1e120, 1e200])
def test_ratios_do_not_depend_on_the_unit_of_the_channels(scale):
    """Fourth powers of the physical channel vanished or overflowed: after one free scalar,
    NMSE 1 or 0.
    """
    plain, scaled = (summarise(ChannelMetrics(s), *channels()) for s in (1.0, scale))
    for name in ("nmse", "nmse_scalar", "snr_db", "power_mae_db"):
        assert scaled[name] == pytest.approx(plain[name], rel=1e-9), name
    assert scaled["mae"] == pytest.approx((scale if 1e-140 < scale < 1e140 else 1) * plain["mae"])


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_batches_change_nothing(kind):
    if kind == "rssi":
        prediction, target = torch.rand(5, 1) + 0.1, torch.rand(5, 1) + 0.1
    else:
        prediction, target = spectra(5) if kind == "spectrum" else channels(5)
    once, parts = OF_KIND[kind].metric(), OF_KIND[kind].metric()
    once.update(prediction, target)
    for rows in (slice(0, 2), slice(2, 5)):
        parts.update(prediction[rows], target[rows])
    assert once.summary(once.compute()) == parts.summary(parts.compute())


def test_perfect_prediction_is_capped_not_infinite():
    _, target = spectra()
    assert summarise(SpectrumMetrics(), target, target)["psnr_db"] == 100.0
    _, channel = channels()
    assert summarise(ChannelMetrics(), channel, channel)["snr_db"] == 100.0


def test_channel_figures_follow_their_definitions():
    prediction, target = channels()
    scale = 3e-5
    figures = summarise(ChannelMetrics(scale), prediction, target)
    error = ((prediction - target).abs() ** 2).sum((1, 2)).double()
    power = (target.abs() ** 2).sum((1, 2)).double()
    assert figures["nmse"] == pytest.approx(float(error.sum() / power.sum()), rel=1e-6)
    assert figures["snr_db"] == pytest.approx(
        float((-10 * (error / power).log10()).mean()), rel=1e-6
    )
    assert figures["mse"] == pytest.approx(float(error.mean() / 24 * scale**2), rel=1e-6)


def test_one_free_scalar_forgives_gain_and_phase_only():
    prediction, target = channels()
    turned = prediction * (2 * torch.exp(1j * torch.arange(5.0)))[:, None, None]
    plain, free = (
        summarise(ChannelMetrics(), p, target)["nmse_scalar"] for p in (prediction, turned)
    )
    assert free == pytest.approx(plain, rel=1e-5)
    assert 0.01 < plain <= summarise(ChannelMetrics(), prediction, target)["nmse"]
    # For a single entry the free scalar is the answer itself.
    assert (
        summarise(ChannelMetrics(), prediction[:, :1, :1], target[:, :1, :1])["nmse_scalar"] is None
    )


def test_a_prediction_below_the_weakest_power_was_no_error():
    """Every weak prediction was lifted to the weakest power scored, not only those without any."""
    target = torch.tensor([[1e-8], [1e-3]])
    figures = summarise(PowerMetrics(), torch.tensor([[1e-12], [1e-3]]), target)
    assert figures["mae_db"] == pytest.approx(20, abs=1e-3)


def test_power_figures_in_decibels(caplog):
    target = torch.tensor([[1e-6], [1e-5], [1e-4]])
    figures = summarise(PowerMetrics(), target * torch.tensor([[10.0], [0.1], [1.0]]), target)
    assert figures["rmse_db"] == pytest.approx(math.sqrt(200 / 3), rel=1e-5)
    assert figures["mae_db"] == pytest.approx(20 / 3, rel=1e-5)
    # Black is read as the weakest power of the set: 0, 10 and 20 dB off.
    black = summarise(PowerMetrics(), torch.zeros(3, 1), target)
    assert black["mae_db"] == pytest.approx(10, rel=1e-5)
    assert not caplog.text  # the zero baseline warned in every run on powers
    partly = summarise(PowerMetrics(), target * torch.tensor([[0.0], [1.0], [1.0]]), target)
    assert partly["mae_db"] == pytest.approx(0) and "1 predictions" in caplog.text
    heard = summarise(PowerMetrics(), target, target, torch.tensor([[True], [False], [True]]))
    assert heard["samples"] == 2  # what was not heard is in no figure, and was counted
    silent = summarise(PowerMetrics(), target, torch.zeros(3, 1))
    assert silent["rmse_db"] is None and silent["silent_samples"] == 3


def test_poison_is_refused():
    prediction, target = spectra()
    prediction[1, 0, 0] = torch.nan
    refused("NaN", SpectrumMetrics().update, prediction, target)
    refused("one shape", SpectrumMetrics().update, target[:, :-1], target)
    refused("empty", SpectrumMetrics().compute)


@pytest.mark.parametrize("kind", ["spectrum", "csi"])
def test_what_nothing_was_measured_of_is_not_perfect(kind):
    """A sample whose mask is empty, or whose target is unknown, scored 100 dB."""
    prediction, target = spectra() if kind == "spectrum" else channels()
    mask = torch.ones(target.shape, dtype=torch.bool)
    mask[0] = False
    unknown = target.clone()
    unknown[0] = torch.nan
    name = "psnr_db" if kind == "spectrum" else "snr_db"
    kept = summarise(OF_KIND[kind].metric(), prediction[1:], target[1:])
    for figures in (
        summarise(OF_KIND[kind].metric(), prediction, target, mask),
        summarise(OF_KIND[kind].metric(), prediction, unknown),
    ):
        for figure in (name, "mse", "mae"):
            assert figures[figure] == pytest.approx(kept[figure]), figure


def test_the_authors_similarity_is_of_zero_padded_images():
    """By a convolution of 11 x 11 with a Gaussian window, as their program has it."""
    draw = torch.Generator().manual_seed(0)
    prediction, target = torch.rand(2, 2, 20, 30, generator=draw, dtype=torch.float64)
    line = torch.exp(-0.5 * ((torch.arange(11) - 5) / 1.5) ** 2).double()
    window = torch.outer(line / line.sum(), line / line.sum())[None, None]
    blur = lambda image: torch.nn.functional.conv2d(image[:, None], window, padding=5)[:, 0]  # noqa: E731
    a, b = blur(prediction), blur(target)
    aa, bb, ab = (
        blur(prediction**2) - a * a,
        blur(target**2) - b * b,
        blur(prediction * target) - a * b,
    )
    local = (2 * a * b + 1e-4) * (2 * ab + 9e-4) / ((a * a + b * b + 1e-4) * (aa + bb + 9e-4))
    metric = SpectrumMetrics()
    metric.update(prediction, target)
    expected = local.mean((1, 2)).numpy()
    np.testing.assert_allclose(metric.compute()["ssim_padded"], expected, rtol=1e-6)
    assert metric.summary(metric.compute())["ssim_padded"] == pytest.approx(
        expected.mean(), rel=1e-6
    )


# Quantiles of a figure with an entry
OF_ANOTHER = {"ssim_median", "snr_db_p10", "snr_db_p50", "snr_db_p90"}


def figure_names(kind):
    shape = {"spectrum": (1, 16, 16), "rssi": (1, 1)}.get(kind, (1, 1, 2))
    one = torch.ones(shape, dtype=torch.complex64 if "csi" in kind else torch.float32)
    metric = OF_KIND[kind].metric()
    metric.update(one, one)
    return set(metric.summary(metric.compute())) - {"samples", "silent_samples"}


@pytest.mark.parametrize("kind", OF_KIND)
def test_every_figure_has_an_entry(kind):
    assert figure_names(kind) - OF_ANOTHER <= set(FIGURES)
    figures = OF_KIND[kind]
    assert {*figures.columns, figures.second} <= figure_names(kind) and figures.of_sample in FIGURES


def test_every_figure_knows_which_way_is_better():
    """The validation error of channels did not:
    the report called the worst moment of a training its best.
    """
    larger = {"psnr_db", "snr_db", "ssim", "ssim_gauss", "ssim_padded", "skill"} | OF_ANOTHER
    larger |= {"psnr_db_median", "ssim_gauss_median"}
    for name in {"skill", *(name for kind in DECIDING for name in figure_names(kind))}:
        assert lower_is_better(name) == (name not in larger), name
        assert (score_of(name, 0.2) > score_of(name, 0.1)) == (name in larger), name


def test_channels_that_are_scored_after_their_freedom_had_no_table():
    """`gsparc compare` and reports of Wi-Fi channels ended in a KeyError."""
    scored = set(get_args(Scored))
    assert set(OF_KIND) == scored
    assert all(score_heading(DECIDING[one]) for one in scored)
