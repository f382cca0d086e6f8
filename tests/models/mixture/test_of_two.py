"""A mixture of two is reduced and forgets rows as one method is and does."""

from collections.abc import Sequence

import numpy as np
import torch
from closed import fitted_to
from interference import plane

from gsparc.data.schema import Measurements
from gsparc.models.closed_form import ClosedForm
from gsparc.models.mixture.methods import Powers
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.powers.field import PowerField


def mixed(mixture: Mixture, members: Sequence[ClosedForm], data: Measurements) -> Mixture:
    mixture.members, mixture.weights, mixture.site = list(members), (0.3, 0.7), data.site
    return mixture


def test_a_mixture_of_two_was_fitted_anew_where_each_member_forgets():
    data = plane(80)
    some, less = np.arange(60), np.arange(30)
    pair = [fitted_to(PowerField(False, seed), data, some)[0] for seed in (0, 1)]
    both = mixed(Powers(), pair, data)
    both.condition(data, some)
    batch = data.batch(np.arange(60, 80))
    before, forgot = both.predict(batch).mean, both.copy_conditioned(data, less)
    assert forgot is not None and torch.equal(both.predict(batch).mean, before)
    both.condition(data, less)
    assert torch.equal(forgot.predict(batch).mean, both.predict(batch).mean)
