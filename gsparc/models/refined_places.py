"""Positions of known errors, refined by what a field says of each row from all others.

A row measured at an error d ~ N(0, s^2) has y = m + J d + e: m is predicted from all other rows, J
its slope by the place, e ~ N(0, c v) with v the prediction's variance. The posterior of d is a
Gauss-Newton step towards the marginal likelihood's maximum over places; McHutchon and Rasmussen
("Gaussian process training with input noise", NeurIPS 2011) leave J d as noise instead.
Rows measured at one place share d.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Batch
from gsparc.data.schema import Measurements
from gsparc.models.closed_form import ClosedForm
from gsparc.models.stack import to_real_entries

log = logging.getLogger(__name__)

SHARES = np.logspace(-3, 1.5, 46)  # c, candidates


@dataclass(frozen=True)
class Linearised:
    """Rows about their places, as real numbers in the unit that errors are counted in.

    Attributes:
        residual: (n, D) float64, measured less predicted from all other rows.
        slope: (n, D, 3) float64 of the prediction [1/m].
        variance: (n, D) float64 of the prediction; infinite where nothing was measured.
    """

    residual: Tensor
    slope: Tensor
    variance: Tensor


def position_errors(
    data: Measurements, rows: np.ndarray, position_std: float | None, can_refine: bool
) -> np.ndarray | None:
    """Return errors (n,) of all rows' coordinates [m]; None where no known row has one,
    or none is used.

    Args:
        data: says errors where nobody asks.
        rows: rows (n,) that are learned from.
        position_std: of every coordinate [m].
        can_refine: whether what is fitted can place rows anew; where not, a warning says so.
    """
    std = data.position_std if position_std is None else np.full(len(data), position_std)
    if std is None or not std[rows].any():
        return None
    if can_refine:
        return std
    measured = "channels with phases of the carrier and powers, of one end that moves"
    log.warning("position_std is not used: it is for %s", measured)
    return None


def estimate_place_errors(seen: Linearised, place: Tensor, std: Tensor) -> tuple[Tensor, float]:
    """Return posterior means of errors (P, 3) [m], and what errors of this size gain [nats].

    Args:
        seen: n rows.
        place: (n,) int64, which of P places each was measured at.
        std: (P,) [m]; of a place without error, the displacement is 0.
    """
    weight, count = 1 / seen.variance, len(std)
    # Errors in units of their own deviation: d / s ~ N(0, 1).
    slope = seen.slope * std[place][:, None, None]
    information = torch.einsum("ndk,ndl,nd->nkl", slope, slope, weight)
    size = information.new_zeros(count, *information.shape[1:]).index_add(0, place, information)
    towards = torch.einsum("ndk,nd,nd->nk", slope, seen.residual, weight)
    pull = towards.new_zeros(count, *towards.shape[1:]).index_add(0, place, towards)
    whole, entries = float((seen.residual.square() * weight).sum()), int((weight > 0).sum())
    trials = []
    for share in SHARES:
        precision = torch.eye(slope.shape[-1], dtype=slope.dtype) + size / share
        unit = torch.linalg.solve(precision, pull[..., None])[..., 0] / share
        # Negative log density of N(m, c v), as if places had no errors.
        exact = (whole / share + entries * math.log(share)) / 2
        # What integrating over d adds, by the matrix inversion and determinant lemmas.
        fit = float((pull * unit).sum()) / share - float(precision.logdet().sum())
        trials.append((exact - fit / 2, exact, unit))
    least, _, unit = min(trials, key=lambda each: each[0])
    # Without errors c is chosen too: a better scale of variances is no gain of theirs.
    return unit * std[:, None], min(exact for _, exact, _ in trials) - least


def refine_places(
    field: ClosedForm, data: Measurements, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return rows (n,), what to add to their places (n, 3) [m], 0 where it does not pay, and why.

    Args:
        field: conditioned on these rows at the places of `data`, channels or powers of one moving
            end.
        std: (S,) [m] standard deviations of each coordinate.
    """
    try:
        rows, seen = _linearise(field, data)
    except ValueError as error:
        none = np.zeros(0, np.int64)
        return none, data.moving[none], f"position_std is not used: {error}"
    _, first, place = np.unique(data.moving[rows], axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    moved, gain = estimate_place_errors(
        seen, torch.from_numpy(place), torch.from_numpy(std[rows][first])
    )
    note = (
        f"log likelihood of rows left out {gain:+.0f} with errors of places (position_std): "
        "positions "
    )
    if gain <= 0:
        return rows, np.zeros_like(data.moving[rows]), f"{note}stay as measured"
    return (
        rows,
        moved.numpy()[place],
        (f"{note}moved by {float(moved.square().mean().sqrt()):.2g} m (rms)"),
    )


def _linearise(field: ClosedForm, data: Measurements) -> tuple[np.ndarray, Linearised]:
    """Rows (n,) that the field was conditioned on, about their places.

    Raises:
        ValueError: the field does not predict its rows from all others.
    """
    left_out, site = field.left_out(), data.site
    batch, moving = data.batch(left_out.rows), torch.from_numpy(data.moving[left_out.rows])
    if left_out.mean.numel() != batch.target.numel():
        raise ValueError(f"{field.name}: of several tones or antennas one is kept of rows left out")

    def batch_at(places: Tensor) -> Batch:
        return batch.with_ends({site.moving_end: places})

    def predict_entries(places: Tensor) -> Tensor:
        return to_real_entries(site.target.in_error_unit(field.predict(batch_at(places)).mean))

    with torch.no_grad():
        # What is computed once and kept must not be so inside `jvp`
        result = field.predict(batch_at(moving))
    assert result.variance is not None
    variance = torch.where(left_out.variance.isnan(), result.variance, left_out.variance).double()
    target = site.target
    answers, variance = target.moments_in_error_unit(left_out.mean, variance)
    true, mean = (
        to_real_entries(values) for values in (target.in_error_unit(batch.target), answers)
    )
    residual = true - mean
    parts = 2 if batch.target.is_complex() else 1
    # Half of a circular variance is in either part.
    spread = (variance / parts)[:, None].expand_as(residual)
    if batch.mask is not None:
        spread = torch.where(batch.mask.flatten(1).repeat_interleave(parts, 1), spread, math.inf)
    axes = torch.eye(moving.shape[1]).to(moving)[:, None].expand(-1, *moving.shape).contiguous()
    slope = [torch.func.jvp(predict_entries, (moving,), (axis,))[1].detach() for axis in axes]
    return left_out.rows, Linearised(residual, torch.stack(slope, -1), spread)


def move_rows(data: Measurements, rows: np.ndarray, offsets: np.ndarray) -> Measurements:
    """Return the moving end of rows (n,) elsewhere by (n, 3) [m]; all else the same."""
    end = data.site.moving_end
    moved = data.ends[end].copy()
    moved[rows] += offsets
    return data.with_ends({end: moved})
