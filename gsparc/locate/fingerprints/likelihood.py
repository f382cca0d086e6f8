"""The density of a fingerprint at places, where each access point is heard or not, and then at a level.

With the probability p of being heard and a Gaussian level, an access point adds `w log p + log N(level)`, or
`w log(1 - p)` where it is silent (a hurdle model: J. G. Cragg, "Some statistical models for limited dependent
variables", Econometrica 39 (1971)). What a device adds to all levels is normal and integrated out in closed
form; what it adds to all log odds of hearing is normal too, and summed over Gauss-Hermite nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from gsparc.locate.likelihood import Misfit, of_levels

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


def shifted(odds: Tensor, here: Tensor, deviation: float) -> Tensor:
    """Log probability (m, B) that of P access points those `here` (m, P), 0 or 1, are heard and no others.

    Args:
        odds: (B, P) log odds, to all of which a row adds one normal variable of `deviation`.
        here: float32.
        deviation: 0 or more.
    """
    at, weight = np.polynomial.hermite_e.hermegauss(NODES if deviation > 0 else 1)
    shift, share = (
        torch.from_numpy(part).float() for part in (deviation * at, np.log(weight / weight.sum()))
    )
    silent = torch.stack([softplus(odds + one).sum(1) for one in shift], -1)
    return here @ odds.T + torch.logsumexp(here.sum(1)[:, None, None] * shift + (share - silent), -1)


def misfit(levels: Tensor, at: Levels, offset: float | None, sensitivity: float = 0.0) -> Misfit:
    """Of m fingerprints at places, in single precision; what is heard and what not is its `silent`.

    Args:
        levels: (m, P) [dBm], NaN where silent.
        at: of B places.
        offset: deviation of what the device adds to all levels [dB]; None or 0: it adds nothing.
        sensitivity: deviation of what it adds to all log odds of hearing.
    """
    near, mean = levels.float() - MIDDLE_DBM, at.mean.float() - MIDDLE_DBM
    found = of_levels(near, mean, at.variance.float(), offset or 0.0)
    here = torch.isfinite(near).float()
    return replace(found, silent=HEARING * shifted(torch.logit(at.heard.float()), here, sensitivity))
