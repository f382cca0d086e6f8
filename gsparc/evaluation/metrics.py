"""Figures of merit of all methods, accumulated per sample so that differences can be paired.

Undefined values (the signal-to-noise ratio of a silent channel, the SSIM of an image smaller than
its window) are NaN in the per-sample arrays, never enter a mean, are counted,
and come out of `summary` as None.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from torch import Tensor

from gsparc.physics.decibels import to_decibels

log = logging.getLogger(__name__)

DB_CAP = 100.0  # a perfect prediction has no finite ratio; 100 dB is beyond any float32 target
# Beyond it or its inverse squares under- or overflow: figures stay in stored units
SMALLEST_UNIT = 1e-140
SILENCE = 1e-6  # of the true power: a silent prediction is 60 dB off, not infinitely
SSIM_WINDOW = 7  # scikit-image's default, the peers' protocol
SSIM_GAUSS_WINDOW = 11  # truncate 3.5 at sigma 1.5
C1, C2 = 0.01**2, 0.03**2  # of data range 1, Wang et al. 2004
MEANS = "ssim_gauss", "ssim_padded", "psnr_db", "mse", "mae"
MEDIANS = "ssim", "ssim_gauss", "psnr_db", "mse"  # beside means, as the paper has them


class SampleMetric:
    """Base: one float64 per sample and quantity, kept in the order of the updates.

    `compute()` gives the arrays, `summary()` the flat figures.

    Args:
        scale: physical target = stored target * scale; spectra have none.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale
        self.parts: list[dict[str, Any]] = []

    def update(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
        """Add B samples; shapes and types of the kind's targets,
        mask like them (True where measured).

        Raises:
            ValueError: shapes differ, or a prediction is not finite.
        """
        if prediction.shape != target.shape:
            shapes = f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)}"
            raise ValueError(f"{shapes} must have one shape")
        if not torch.isfinite(prediction).all():
            raise ValueError("a prediction holds NaN or Inf; it is not scored")
        self.parts.append(self._score(prediction.detach().cpu(), target.detach().cpu(), mask))

    def compute(self) -> dict[str, np.ndarray]:
        """Return per-sample quantities, each (S,) float64.

        Raises:
            ValueError: no sample was added.
        """
        if not self.parts:
            raise ValueError("no sample was scored: the chosen subset is empty")
        columns = ((name, [part[name] for part in self.parts]) for name in self.parts[0])
        return {name: np.concatenate(values).astype(np.float64) for name, values in columns}

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        raise NotImplementedError

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        """Return flat figures from per-sample arrays (pooled over folds by concatenation)."""
        raise NotImplementedError


class SpectrumMetrics(SampleMetric):
    """Spectra (B, H, W) in [0, 1]: SSIM in both windows and zero padded, PSNR, MSE, MAE, NMSE.

    >>> metric = SpectrumMetrics()
    >>> metric.update(torch.full((2, 16, 16), 0.4), torch.full((2, 16, 16), 0.5))
    >>> figures = metric.summary(metric.compute())
    >>> round(figures["psnr_db"], 2), round(figures["mae"], 3), figures["samples"]
    (20.0, 0.1, 2)
    """

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        p, t = prediction.double().numpy(), target.double().numpy()
        m = np.ones(t.shape, bool) if mask is None else mask.numpy()
        p = np.where(m, p, t)  # an unmeasured pixel can be neither right nor wrong
        count = _nonzero(m.sum((1, 2)))
        mse = ((p - t) ** 2).sum((1, 2)) / count
        return {
            "ssim": [_ssim(a, b, w, SSIM_WINDOW) for a, b, w in zip(p, t, m, strict=True)],
            "ssim_gauss": [
                _ssim(a, b, w, SSIM_GAUSS_WINDOW) for a, b, w in zip(p, t, m, strict=True)
            ],
            "ssim_padded": [_ssim_padded(a, b, w) for a, b, w in zip(p, t, m, strict=True)],
            "psnr_db": _db(np.ones_like(mse), mse),
            "mse": mse,
            "mae": np.abs(p - t).sum((1, 2)) / count,
            "target_power": (np.where(m, t, 0.0) ** 2).sum((1, 2)) / count,
        }

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        """See the base class."""
        return {
            "ssim": _statistic(samples["ssim"]),
            **{name: _statistic(samples[name]) for name in MEANS},
            **{f"{name}_median": _statistic(samples[name], np.nanmedian) for name in MEDIANS},
            "nmse": _ratio(samples["mse"], samples["target_power"]),
            "samples": len(samples["mse"]),
        }


class ChannelMetrics(SampleMetric):
    """CSI (B, antennas, subcarriers) complex, denormalised: NMSE, SNR,
    NMSE after one complex scalar each.

    `power_mae_db` is the mean absolute error of a sample's power in dB,
    the figure of coverage maps.

    >>> metric, channel = ChannelMetrics(), torch.tensor([[[1 + 0j, 1j]]])
    >>> metric.update(0.9 * channel, channel)
    >>> figures = metric.summary(metric.compute())
    >>> round(figures["snr_db"], 2), round(figures["nmse"], 4), round(figures["nmse_scalar"], 4)
    (20.0, 0.01, 0.0)
    """

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        # In stored units, which are near 1: fourth powers of 1e-90 or 1e90 under- or overflow.
        p, t = (x.to(torch.complex128).flatten(1).numpy() for x in (prediction, target))
        m = np.ones(t.shape, bool) if mask is None else mask.flatten(1).numpy()
        p, t, count = np.where(m, p, 0), np.where(m, t, 0), _nonzero(m.sum(1))
        error, power = (np.abs(p - t) ** 2).sum(1), (np.abs(t) ** 2).sum(1)
        p_power, cross = (np.abs(p) ** 2).sum(1), np.abs((p.conj() * t).sum(1)) ** 2
        # The projection onto the prediction: what the best complex scalar explains of the channel.
        explained = np.divide(cross, p_power, out=np.zeros_like(p_power), where=p_power > 0)
        # One free scalar fits a single-entry channel exactly: the figure is undefined there.
        residual = np.maximum(power - explained, 0.0) if t.shape[1] > 1 else power * np.nan
        scale = self.scale if SMALLEST_UNIT <= self.scale <= 1 / SMALLEST_UNIT else 1.0
        unit = scale**2
        return {
            "error_power": error * unit,
            "target_power": power * unit,
            "scalar_error_power": residual * unit,
            "snr_db": _db(power, error),
            "mse": error / count * unit,
            "mae": np.abs(p - t).sum(1) / count * scale,
            "power_db": np.where(
                power > 0, _db(np.maximum(p_power, power * SILENCE), power), np.nan
            ),
        }

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        """See the base class."""
        silent = int((samples["target_power"] == 0).sum())
        if silent:
            log.warning(
                "%d of %d channels are all zero: left out of snr_db", silent, len(samples["mse"])
            )
        return {
            "nmse": _ratio(samples["error_power"], samples["target_power"]),
            "nmse_scalar": _ratio(samples["scalar_error_power"], samples["target_power"]),
            "snr_db": _statistic(samples["snr_db"]),
            **{
                f"snr_db_p{p}": _statistic(samples["snr_db"], np.nanquantile, p / 100)
                for p in (10, 50, 90)
            },
            "mse": _statistic(samples["mse"]),
            "mae": _statistic(samples["mae"]),
            "power_mae_db": _statistic(np.abs(samples["power_db"])),
            "silent_samples": silent,
            "samples": len(samples["mse"]),
        }


class AlignedChannelMetrics(ChannelMetrics):
    """Channels whose rows have factors of their own,
    predictions turned to each row by what is free of it.

    `tone_rmse_db` is the error of levels at single subcarriers and antennas.
    """

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        p, t = (x.abs().double().flatten(1).numpy() for x in (prediction, target))
        valid = t > 0 if mask is None else (t > 0) & mask.flatten(1).numpy()
        # SILENCE is a share of power, levels here are amplitudes.
        floor = SILENCE**0.5 * np.where(valid, t, 1.0)
        decibels = 20 * np.log10(np.maximum(p, floor) / np.where(valid, t, 1.0))
        squares = np.where(valid, decibels**2, 0).sum(1) / _nonzero(valid.sum(1))
        return {**super()._score(prediction, target, mask), "tone_db2": squares}

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        """See the base class."""
        figures = ChannelMetrics.summary(samples)
        aligned, squares = figures.pop("nmse"), _statistic(samples["tone_db2"])
        tones = None if squares is None else float(np.sqrt(squares))
        return {"nmse_aligned": aligned, "tone_rmse_db": tones, **figures}


class PowerMetrics(SampleMetric):
    """RSSI (B, 1), linear power, denormalised: errors in dB and the linear NMSE.

    A prediction at or below zero is taken as the weakest power measured in the scored set, and
    counted; a target at or below zero has no decibels and is left out of the dB figures.

    >>> metric = PowerMetrics()
    >>> metric.update(torch.tensor([[1e-7], [1e-8]]), torch.tensor([[1e-7], [1e-9]]))
    >>> round(metric.summary(metric.compute())["mae_db"], 3)  # 0 dB and 10 dB
    5.0
    """

    def _score(self, prediction: Tensor, target: Tensor, mask: Tensor | None) -> dict[str, Any]:
        p, t = (x.double().flatten() * self.scale for x in (prediction, target))
        return {
            "prediction": p,
            "target": t if mask is None else t.masked_fill(~mask.flatten(), torch.nan),
        }

    def compute(self) -> dict[str, np.ndarray]:
        """Add `power_errors`."""
        raw = super().compute()
        return {**raw, **power_errors(raw["prediction"], raw["target"])}

    @staticmethod
    def summary(samples: dict[str, np.ndarray]) -> dict[str, float | None]:
        """See the base class."""
        floored, silent = (
            int((samples["prediction"] <= 0).sum()),
            int((samples["target"] <= 0).sum()),
        )
        if not samples["prediction"].any():
            floored = 0  # zeros alone are meant, as the baseline's are
        if floored or silent:
            log.warning(
                "%d predictions and %d targets without power (no decibels there)", floored, silent
            )
        squared = _statistic(samples["error_db"] ** 2)
        return {
            "rmse_db": None if squared is None else float(np.sqrt(squared)),
            "mae_db": _statistic(np.abs(samples["error_db"])),
            "mae_db_median": _statistic(np.abs(samples["error_db"]), np.nanmedian),
            "nmse": _ratio(samples["error_power"], samples["target_power"]),
            "mse": _statistic(samples["mse"]),
            "silent_samples": silent,
            "samples": int((~np.isnan(samples["target"])).sum()),  # those where something was heard
        }


def power_errors(predicted: np.ndarray, target: np.ndarray) -> dict[str, np.ndarray]:
    """Return errors (S,) of linear predictions and targets (S,),
    in decibels and of the linear values.
    """
    positive = target > 0
    # A power of 0 or less has no decibels: it counts as the weakest that was measured.
    floor = target[positive].min() if positive.any() else np.finfo(np.float64).tiny
    error_db = np.where(
        positive,
        _db(np.where(predicted > 0, predicted, floor), np.where(positive, target, 1.0)),
        np.nan,
    )
    error = np.where(np.isnan(target), np.nan, (predicted - target) ** 2)
    return {"error_db": error_db, "error_power": error, "target_power": target**2, "mse": error}


def _ssim(prediction: np.ndarray, target: np.ndarray, measured: np.ndarray, window: int) -> float:
    """Mean structural similarity of two float64 images over measured pixels;
    NaN below the window's size.
    """
    if min(target.shape) < window:
        return float("nan")
    if window == SSIM_WINDOW:
        options: dict[str, Any] = {"win_size": window}
    else:
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    if measured.all():
        return float(structural_similarity(prediction, target, data_range=1.0, **options))
    _, local = structural_similarity(prediction, target, data_range=1.0, full=True, **options)
    inner = (slice(window // 2, -(window // 2)),) * 2  # full windows only, as in the plain mean
    return float(local[inner][measured[inner]].mean()) if measured[inner].any() else float("nan")


def _ssim_padded(prediction: np.ndarray, target: np.ndarray, measured: np.ndarray) -> float:
    """Mean structural similarity over all measured pixels of images continued
    by zeros (the authors).
    """
    if min(target.shape) < SSIM_GAUSS_WINDOW:
        return float("nan")
    blur = partial(gaussian_filter, sigma=1.5, mode="constant", radius=SSIM_GAUSS_WINDOW // 2)
    mean_p, mean_t = blur(prediction), blur(target)
    variances = blur(prediction**2) + blur(target**2) - mean_p**2 - mean_t**2
    covariance = blur(prediction * target) - mean_p * mean_t
    light = (2 * mean_p * mean_t + C1) / (mean_p**2 + mean_t**2 + C1)
    local = light * (2 * covariance + C2) / (variances + C2)
    return float(local[measured].mean()) if measured.any() else float("nan")


def _db(signal: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """10 log10(signal / noise) within +-DB_CAP;
    NaN where there is no signal or nothing is known.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        # A difference of logarithms: the ratio of 1e-200 and 1e200 is no float64.
        ratio = to_decibels(signal) - to_decibels(noise)
    return np.where(
        signal > 0, np.clip(np.where(noise == 0, np.inf, ratio), -DB_CAP, DB_CAP), np.nan
    )


def _nonzero(entries: np.ndarray) -> np.ndarray:
    """Numbers of measured entries (B,) to divide by; NaN where nothing was measured."""
    return np.where(entries > 0, entries, np.nan)


def _statistic(
    values: np.ndarray, of: Callable[..., Any] = np.nanmean, *share: float
) -> float | None:
    """The mean of the values that are not NaN, or another statistic `of` them;
    None where there are none.
    """
    return None if np.isnan(values).all() else float(of(values, *share))


def _ratio(error: np.ndarray, power: np.ndarray) -> float | None:
    total = float(np.nansum(power))
    return float(np.nansum(error)) / total if total > 0 and not np.isnan(error).all() else None
