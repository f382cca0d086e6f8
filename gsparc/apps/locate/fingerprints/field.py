"""The field of fingerprints: how probably each access point is heard at a place, and at what level.

One process with one kernel for all: its outputs are, of each access point, whether it was heard (0 or 1) and
its level above a base where it was heard, 0 where not. The ratio of the two is the mean of a heard level: a
floor in place of silent rows would bias it. What the process says of rows at places left out calibrates the
variance of each access point and the log odds of hearing.

The density: with the probability p of being heard and a Gaussian level, an access point adds
`w log p + log N(level)`, or `w log(1 - p)` where it is silent (a hurdle model: J. G. Cragg, "Some statistical
models for limited dependent variables", Econometrica 39 (1971)). What a device adds to all levels is normal
and integrated out in closed form; what it adds to all log odds of hearing is normal too, and summed over
Gauss-Hermite nodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from sklearn.linear_model import LogisticRegression
from torch import Tensor
from torch.nn.functional import softplus

from gsparc.apps.locate.likelihood import Misfit, of_levels
from gsparc.apps.locate.shared_kernel import settings, stretched
from gsparc.processes.nearest import Nearest, Values, given

BELOW_DB = 1.0  # of the faintest level, that the base lies
RARE = 0.05  # probability below which a ratio of two small numbers is no level
SURE = 0.002  # no place makes silence, or hearing, less probable
LEAST_DB2 = 1.0  # common variance of a level: receivers round
PRIOR_ROWS = 10.0  # that the common variance counts as beside an access point's own
ROWS = 500  # that calibrate the odds of hearing
SENSITIVITIES = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0)
PLACES = 2_048  # whose moments are in memory at a time
NODES = 7  # of the sum over sensitivities; of a deviation of 1 more change no log density by 0.01 nats
MIDDLE_DBM = -70.0  # levels are small numbers about it: squares lose less in float32
HEARING = 0.5  # w: access points of one device fall silent together, so that they count for fewer


@dataclass(frozen=True)
class Levels:
    """What is expected at B places of P access points.

    Attributes:
        mean: (B, P) of a level that is heard [dBm].
        variance: (B, P) of one measurement [dB^2].
        heard: (B, P) probability in (0, 1).
    """

    mean: Tensor
    variance: Tensor
    heard: Tensor


@dataclass(frozen=True)
class FingerprintField:
    """Learned from rows of P access points.

    Attributes:
        process: of 2 P outputs, heard and level above the base, less their means.
        mean: (2, P) of these.
        base: (P,) [dBm].
        variance: (P,) of a heard level [dB^2] in units of the process's variance.
        odds: slope and intercept of the log odds of hearing by those of the process.
        sensitivity: deviation of what a row adds to all log odds.
        vertical: what a metre of height counts as along the floor.
    """

    process: Nearest
    mean: Tensor
    base: Tensor
    variance: Tensor
    odds: tuple[float, float]
    sensitivity: float
    vertical: float

    @torch.no_grad()
    def moments(self, places: Tensor) -> Levels:
        """Return what would be heard at places (B, 3) float64 [m]."""
        at = torch.from_numpy(stretched(places.detach().double().numpy(), self.vertical))
        answer = self.process.answer(at)
        heard, level = (answer.mean.unflatten(1, (2, -1)) + self.mean).unbind(1)
        variance = answer.left.float()[:, None] * self.variance
        return Levels(self.base + above(heard, level), variance, calibrated(heard, self.odds).sigmoid())


def above(heard: Tensor, level: Tensor) -> Tensor:
    """Mean of heard levels above the base (..., P) [dB]: that of all rows over how often one is heard."""
    return level.clamp_min(0.0) / heard.clamp_min(RARE)


def calibrated(heard: Tensor, odds: tuple[float, float]) -> Tensor:
    """Log odds of hearing (..., P) by what the process says of 0 and 1, which may lie beyond these."""
    bound = math.log(1 / SURE - 1)
    return (odds[0] * torch.logit(heard.clamp(SURE, 1 - SURE)) + odds[1]).clamp(-bound, bound)


def learn(
    levels: np.ndarray, places: np.ndarray, seed: int = 0, like: FingerprintField | None = None
) -> FingerprintField:
    """Return the field of rows, with the kernel of another where one is given.

    Example:
        field = learn(rows.level[train], rows.position[train])
        field.moments(torch.from_numpy(candidates)).mean

    Levels are (n, P) [dBm], NaN where silent, places (n, 3) float64 [m]; `ValueError` where all are silent.
    """
    level = torch.from_numpy(levels).float()
    heard = torch.isfinite(level)
    if not heard.any():
        raise ValueError(f"fingerprints: {len(levels)} rows heard no access point; give rows with levels")
    faintest = torch.where(heard, level, math.inf).amin(0)
    base = torch.where(heard.any(0), faintest, faintest.amin()) - BELOW_DB
    outputs = torch.cat([heard.float(), torch.where(heard, level - base, 0.0)], 1)
    mean = outputs.mean(0)
    outputs -= mean
    kernel = (like.process.prior, like.vertical) if like else None
    prior, vertical = kernel or settings(outputs[:, len(base) :], places, seed)
    at = stretched(places, vertical)
    process = given(prior, Values.of(at, outputs), seed)
    del outputs
    mean, (left_out, left) = mean.unflatten(0, (2, -1)), process.left_out()
    place = torch.from_numpy(np.unique(at, axis=0, return_inverse=True)[1].reshape(-1))
    squares, times = torch.zeros(len(base)), heard.sum(0)
    for rows in torch.arange(len(level)).split(PLACES):
        predicted = left_out[place[rows]].unflatten(1, (2, -1)) + mean
        error = torch.nan_to_num(level[rows] - base - above(*predicted.unbind(1)))
        squares += (error.square() / left[place[rows], None].float()).sum(0)
    common = (squares.sum() / times.sum()).clamp_min(LEAST_DB2)
    variance = (squares + PRIOR_ROWS * common) / (times + PRIOR_ROWS)
    sample = torch.from_numpy(np.sort(np.random.default_rng(seed).permutation(len(level))[:ROWS]))
    odds, sensitivity = hearing(left_out[place[sample], : len(base)] + mean[0], heard[sample])
    return FingerprintField(process, mean, base, variance, odds, sensitivity, vertical)


def hearing(predicted: Tensor, heard: Tensor) -> tuple[tuple[float, float], float]:
    """Slope and intercept of log odds, and the deviation of a row's shift, most likely by rows (n, P).

    Args:
        predicted: what the process says of 0 and 1 at places left out.
        heard: bool.
    """
    odds = (1.0, 0.0)
    if 0 < heard.sum() < heard.numel():
        entries = calibrated(predicted, odds).reshape(-1, 1), heard.reshape(-1)
        fitted = LogisticRegression(C=1e3).fit(*entries)
        odds = float(fitted.coef_[0, 0]), float(fitted.intercept_[0])
    shift, here = calibrated(predicted, odds), heard.float()  # rows at their own places: the diagonal
    return odds, max(SENSITIVITIES, key=lambda one: float(shifted(shift, here, one).diagonal().sum()))


def shifted(odds: Tensor, here: Tensor, deviation: float) -> Tensor:
    """Log probability (m, B) that of P access points those `here` (m, P), 0 or 1, are heard and no others.

    To all log odds (B, P) a row adds one normal variable of a `deviation` of 0 or more; `here` is float32.
    """
    at, weight = np.polynomial.hermite_e.hermegauss(NODES if deviation > 0 else 1)
    shift, share = (
        torch.from_numpy(part).float() for part in (deviation * at, np.log(weight / weight.sum()))
    )
    silent = torch.stack([softplus(odds + one).sum(1) for one in shift], -1)
    return here @ odds.T + torch.logsumexp(here.sum(1)[:, None, None] * shift + (share - silent), -1)


def misfit(levels: Tensor, at: Levels, offset: float | None, sensitivity: float = 0.0) -> Misfit:
    """Return the misfit of m fingerprints at places, in float32; what is heard and what not is its `silent`.

    Args:
        levels, at: (m, P) [dBm], NaN where silent; of B places.
        offset: deviation of what the device adds to all levels [dB]; None or 0: it adds nothing.
        sensitivity: deviation of what it adds to all log odds of hearing.
    """
    near, mean = levels.float() - MIDDLE_DBM, at.mean.float() - MIDDLE_DBM
    levels_misfit = of_levels(near, mean, at.variance.float(), offset or 0.0)
    here = torch.isfinite(near).float()
    return replace(levels_misfit, silent=HEARING * shifted(torch.logit(at.heard.float()), here, sensitivity))
