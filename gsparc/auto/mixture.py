"""Predictions averaged in the unit they are judged in: decibels of powers, else as they are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsparc.data.schema import Kind
from gsparc.methods.method import Prediction
from gsparc.methods.target_rows import TINY_POWER

DB = 10 / math.log(10)


def judged(target: Tensor, kind: Kind) -> Tensor:
    """Targets or predictions (B, ...), stored units, as rows (B, D) of the unit they are judged in."""
    flat = target.flatten(1)
    return 10 * torch.log10(flat.double().clamp_min(TINY_POWER)) if kind == "rssi" else flat


def judged_variance(variance: Tensor, mean: Tensor, kind: Kind) -> Tensor:
    """A variance (B,) about `mean` (B, ...) in that unit, squared; to first order where it is decibels."""
    if kind != "rssi":
        return variance
    return variance.double() / (mean.flatten(1).double().mean(1).clamp_min(TINY_POWER) / DB) ** 2


def mixed(
    parts: Sequence[Prediction], weights: Sequence[float], errors: Sequence[float], scale: float, kind: Kind
) -> Prediction:
    """The weighted mean, with the variance of a mixture: the parts' own, and that of their means.

    Args:
        parts: predictions of the same B rows.
        weights: of the parts, summing to one.
        errors: left-out mean squared error of each, which stands for a variance that it does not say.
        scale: factor of the variance.
        kind: of the targets.
    """
    rows = [judged(part.mean, kind) for part in parts]
    mean = torch.stack([w * row for w, row in zip(weights, rows, strict=True)]).sum(0)
    variance = torch.zeros(len(mean), dtype=torch.float64)
    for part, row, weight, error in zip(parts, rows, weights, errors, strict=True):
        own = part.variance
        said = torch.full_like(variance, error) if own is None else judged_variance(own, part.mean, kind)
        variance += weight * (said + (row - mean).abs().square().mean(1))
    variance *= scale
    sure = [(w, p.confidence) for w, p in zip(weights, parts, strict=True) if p.confidence is not None]
    total = sum(weight for weight, _ in sure)
    confidence = sum((w / total * c for w, c in sure), torch.zeros(len(mean))) if sure else None
    shape = parts[0].mean.shape
    if kind == "rssi":
        power = (10 ** (mean / 10)).float()
        spoken = variance * (power.double().mean(1) / DB) ** 2
        return Prediction(power.reshape(shape), confidence, spoken.float())
    return Prediction(mean.reshape(shape).to(parts[0].mean.dtype), confidence, variance.float())
