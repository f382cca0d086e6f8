"""A mixture of two is reduced and forgets rows as one method is and does."""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from campaigns import channels
from closed import fitted_to
from interference import plane

from gsparc.data.schema import Measurements
from gsparc.datasets.load import load
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.method import Prediction
from gsparc.models.mixture.methods import ImageSources, Powers
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.powers.field import PowerField
from gsparc.processes.uncertainty import variance_factor


def mixed(mixture: Mixture, members: Sequence[ClosedForm], data: Measurements) -> Mixture:
    mixture.members, mixture.weights, mixture.site = list(members), (0.3, 0.7), data.site
    return mixture


def test_a_mixture_of_two_was_fitted_anew_where_each_member_forgets():
    data = plane(80)
    some, less = np.arange(60), np.arange(30)
    pair = [fitted_to(PowerField(seed), data, some)[0] for seed in (0, 1)]
    both = mixed(Powers(), pair, data)
    both.condition(data, some)
    batch = data.batch(np.arange(60, 80))
    before, forgot = both.predict(batch).mean, both.copy_conditioned(data, less)
    assert forgot is not None and torch.equal(both.predict(batch).mean, before)
    both.condition(data, less)
    assert torch.equal(forgot.predict(batch).mean, both.predict(batch).mean)


def test_variances_are_mended_by_rows_that_members_left_out(tmp_path):
    """Validation rows alone said .35 to .87 in three draws of a room where .47 was right."""
    data = load({"name": "own", "file": str(channels(tmp_path / "room.npz", rows=60))})
    stated, val = 1 + torch.arange(60.0), np.arange(10)
    silence = torch.zeros(60, *data.target.shape[1:], dtype=torch.complex64)

    def answer(query):
        return Prediction(*(part[: len(query)] for part in (silence, stated, stated)))

    held = [np.array([40, 12, 33, 50]), np.array([33, 50, 12])]
    members = [
        SimpleNamespace(predict=answer, held=LeftOutRows(rows, silence[rows], stated[rows]))
        for rows in held
    ]
    ratios = np.mean(np.abs(data.target) ** 2, (1, 2)) / stated.numpy()
    mixture = mixed(ImageSources(), members, data)
    wanted = variance_factor(ratios[np.r_[val, 12, 33, 50]])
    assert mixture._measure_doubt(data, val) == pytest.approx(wanted, rel=1e-4)
    members[1].held = None
    wanted = variance_factor(ratios[val])
    assert mixture._measure_doubt(data, val) == pytest.approx(wanted, rel=1e-4)
