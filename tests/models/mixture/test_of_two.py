"""A mixture of two is reduced and forgets rows as one method is and does."""

from collections.abc import Sequence

import numpy as np
import torch
from boxes import room_of_spectra
from closed import fitted_to
from interference import plane

from gsparc.data.schema import Measurements
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.closed_form import ClosedForm
from gsparc.models.mixture.methods import Bearings, Powers
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.powers.field import PowerField


def mixed(mixture: Mixture, members: Sequence[ClosedForm], data: Measurements) -> Mixture:
    mixture.members, mixture.weights, mixture.site = list(members), (0.3, 0.7), data.site
    return mixture


def test_each_member_is_reduced_and_variance_is_left_out():
    data = room_of_spectra()
    pair = [fitted_to(GaussianProcess(), data, rows)[0] for rows in (np.arange(20), np.arange(40))]
    both, batch = mixed(Bearings(), pair, data), data.batch(np.arange(40, 60))
    knobs = {"keep": 0.5, "stride": 2, "confidence": False}
    assert set(both.reduction_settings()) == set(knobs)
    means = [member.reduce(knobs, {}).predict(batch).mean for member in pair]
    lean = both.reduce(knobs, {}).predict(batch)
    assert torch.allclose(lean.mean, 0.3 * means[0] + 0.7 * means[1]) and lean.variance is None
    assert not torch.allclose(lean.mean, both.predict(batch).mean)
    assert both.reduce({}, {}) is both


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
