"""Several predictors of the same rows as one: weights by rows that none of them learned from.

Stacked regression with weights that are not negative and sum to one: L. Breiman, "Stacked
regressions", Machine Learning 24 (1996). With e_ik the error of prediction k in row i, the squared
error of a mixture w is w^T G_i w, G_i = e_i e_i^T, so that weights are functions of these products
alone. Weights are learned on some units of rows and tried on the others; a mixture is taken where
it surely beats one predictor alone there.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from gsparc.data.inner_folds import NOT_TESTED, InnerFolds
from gsparc.data.schema import Measurements
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import factors_to_measured
from gsparc.physics.decibels import TINY_POWER
from gsparc.processes.uncertainty import mean_and_error

log = logging.getLogger(__name__)

LEAST_HELD = 4  # rows, for weights to mean anything
UNUSED = 0.05  # weight below which a predictor is left out of a mixture
SHARPNESS = 4  # weight of a fit = error^-4: 1.5 times the error weighs a fifth
PARTS = 5  # of the units; weights are learned on all but one, and tried on that
LEAST_ERROR = 1e-9  # of a row: its logarithm stays finite


def error_products(predicted: Sequence[Tensor], target: Tensor) -> np.ndarray:
    """Return products (n, K, K) of the errors of K predictions (n, ...),
    means over real entries.
    """
    missed = [to_real_entries((mean - target).detach()) for mean in predicted]
    return torch.stack(
        [torch.stack([(a * b).mean(1) for b in missed], 1) for a in missed], 1
    ).numpy()


def choose_weights(
    gram: np.ndarray, unit: np.ndarray, deviations: float = 1.0, least: float = 0.0, few: int = 0
) -> np.ndarray:
    """Return weights (K,) in [0, 1] of sum one, none below `UNUSED`: one alone,
    unless a mixture is better.

    Args:
        gram: (n, K, K) products of the errors of n rows.
        unit: (n,), rows of one unit are not independent.
        deviations: standard errors that the gain over one alone must exceed.
        least: smallest relative gain where predictor 0 is the best one: a mixture answers more
            slowly. Where another is the best, any mixture is taken: it holds predictor 0 and costs
                no more.
        few: units below which predictors that they do not tell apart weigh alike (J. M. Bates and
            C. W. J. Granger, 1969).
    """
    errors, count = np.einsum("nkk->nk", gram), gram.shape[1]
    winner = int(errors.mean(0).argmin())
    single, part = np.eye(count)[winner], np.unique(unit, return_inverse=True)[1].reshape(-1)
    if count < 2 or part.max() == 0:
        return single
    gains = (
        mean_and_error(errors[:, k] - errors[:, winner], unit) for k in range(count) if k != winner
    )
    if part.max() + 1 < few and all(gain < 2 * error for gain, error in gains):
        return np.full(count, 1 / count)
    part, mixed = part % PARTS, np.empty(len(gram))
    for tested in (part == number for number in range(int(part.max()) + 1)):
        mixed[tested] = mixture_errors(best_weights(gram[~tested].mean(0)), gram[tested])
    gain, error = mean_and_error(errors[:, winner] - mixed, unit)
    if gain > max(least * errors[:, winner].mean(), deviations * error) or (winner and least):
        return best_weights(gram.mean(0))
    return single


def relative_to_row(gram: np.ndarray) -> np.ndarray:
    """Return products (n, K, K) over the mean of a row's errors: rows count by ratios,
    as in a mean PSNR.
    """
    errors = np.einsum("nkk->nk", gram)
    return gram / np.exp(np.log(errors + LEAST_ERROR).mean(1))[:, None, None]


def best_weights(gram: np.ndarray) -> np.ndarray:
    """Return weights (K,) of the smallest w^T `gram` w, of sum one, none negative,
    or below `UNUSED` but 0.

    Scaled to any sum s, the smallest s^2 w^T G w + (s - 1)^2 belongs to the same w: plain
    non-negative least squares.
    """
    used = np.arange(len(gram))
    while True:
        values, vectors = np.linalg.eigh(gram[np.ix_(used, used)])
        root = (
            np.sqrt(np.maximum(values / max(values.sum(), np.finfo(float).tiny), 0.0))[:, None]
            * vectors.T
        )
        shares = nnls(np.vstack([root, np.ones(len(used))]), np.append(np.zeros(len(used)), 1.0))[0]
        large = shares >= UNUSED * shares.sum()
        if large.all():
            return np.bincount(used, shares / shares.sum(), len(gram))
        used = used[large]


def weights_of_fits(errors: Tensor) -> Tensor:
    """Return weights (K,) of fits by their errors (K,) at rows that they were fitted to,
    each left out alone.

    Products of errors would overrate a mean of searches, whose errors are small because they were
    searched for: test errors went 10 % up and down.
    """
    return torch.softmax(-SHARPNESS * errors.log(), 0)


def mixture_errors(weights: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """Return the squared errors (n,) of a mixture (K,) from products (n, K, K)."""
    return np.einsum("k,nkl,l->n", weights, gram, weights)


def explained_variance(predicted: Tensor, target: Tensor, remove_mean: bool) -> float:
    """Return the share of variance that a prediction explains, of complex targets about 0;
    at most 1.
    """
    middle = target.mean(0, keepdim=True) if remove_mean else torch.zeros_like(target[:1])
    whole = (target - middle).abs().square().sum().clamp_min(TINY_POWER)
    return 1 - float((predicted - target).abs().square().sum() / whole)


def to_real_entries(values: Tensor) -> Tensor:
    """Return entries (n, P) float64 of values (n, ...),
    real and imaginary parts of complex ones.
    """
    values = torch.view_as_real(values.resolve_conj()) if values.is_complex() else values
    return values.double().flatten(1)


def leave_out_groups(
    member: ClosedForm, data: Measurements, rows: np.ndarray, groups: Sequence[np.ndarray]
) -> LeftOutRows | None:
    """Return predictions of every group of rows by a member conditioned on rows (n,)
    without that group.

    Its parameters stay those of all rows. None without groups. The member stays as it is.
    """
    if not groups:
        return None
    answers, clone = [], copy.copy(member)
    for group in groups:
        clone.condition(data, np.setdiff1d(rows, group))
        answers.append(clone.predict(data.batch(group)))
    mean, variance = (
        torch.cat([getattr(answer, name) for answer in answers]) for name in ("mean", "variance")
    )
    number = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return LeftOutRows(np.concatenate(groups), mean, variance, number)


def weigh_members(
    members: Mapping[str, ClosedForm],
    data: Measurements,
    val: np.ndarray,
    cut: InnerFolds | None,
    deviations: float = 1.0,
) -> dict[str, float]:
    """Return weights of members where positive, by rows which none of them was conditioned on.

    Args:
        members: one or more; one alone needs no rows.
        data: measurements.
        val: (v,) rows that none learned from, which are compared beside those that all left out by
            groups.
        cut: of the groups; None only for one member.
        deviations: see `choose_weights`.
    """
    first = next(iter(members))
    if len(members) == 1:
        return {first: 1.0}
    left_out = [member.held for member in members.values() if member.held is not None]
    rows = np.zeros(0, np.int64)
    if len(left_out) == len(members):
        # Only rows that every member was without can be compared.
        rows = np.asarray(
            functools.reduce(np.intersect1d, [member.rows for member in left_out]), np.int64
        )
    batch, predicted = data.batch(val), []
    for method in members.values():
        mean = method.predict(batch).mean
        if method.held is not None and len(rows):
            order = np.argsort(method.held.rows)
            mean = torch.cat(
                [
                    method.held.mean[order[np.searchsorted(method.held.rows, rows, sorter=order)]],
                    mean,
                ]
            )
        predicted.append(mean)
    rows = np.concatenate([rows, val])
    if len(rows) < LEAST_HELD:
        log.info("%d rows are too few to weigh solutions by: init=%s alone", len(rows), first)
        return {first: 1.0}
    if data.site.unknown_factor != "none":  # errors are counted after it
        predicted = [mean * factors_to_measured(mean, data, rows) for mean in predicted]
    predicted = [data.site.target.in_error_unit(mean) for mean in predicted]
    target = data.site.target.in_error_unit(data.batch(rows).target)
    assert cut is not None
    single = cut.unit.max() + 1 + np.arange(len(cut.unit))  # of validation rows that no group has
    unit = np.where(cut.unit == NOT_TESTED, single, cut.unit)[rows]
    gram = error_products(predicted, target)
    weights = choose_weights(gram, unit, deviations)
    power = max(float(to_real_entries(target).square().mean()), TINY_POWER)
    for name, error, weight in zip(members, gram.mean(0).diagonal() / power, weights, strict=True):
        log.info(
            "%d held-out rows: %s has an NMSE of %.3f, weight %.2f", len(rows), name, error, weight
        )
    return {name: float(weight) for name, weight in zip(members, weights, strict=True) if weight}
