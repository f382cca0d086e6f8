"""The plain process as one of the solutions that are weighed."""

import numpy as np
import torch
from boxes import room_of_spectra
from closed import fitted_to

from gsparc.data.inner_folds import cut_folds
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.closed_form import ClosedForm, LeftOutRows
from gsparc.models.mixture.fit_candidates import weigh_candidates
from gsparc.models.mixture.methods import Channels


def test_sources_of_few_rows_lost_a_decibel_to_the_process():
    """Bearings of a moving array were weighed against nothing."""
    data = room_of_spectra()
    few = np.arange(0, 24)
    good, _ = fitted_to(GaussianProcess(), data, few)
    spoilt, _ = fitted_to(GaussianProcess(), data, few)
    spoilt.mean = spoilt.mean + 0.3
    fold = Fold(few, np.arange(24, 40), np.arange(40, 60))
    cut = cut_folds(data, fold, None, 3, 0)
    assert weigh_candidates({"bearings": spoilt, "process": good}, data, fold.val, cut) == {
        "process": 1.0
    }


class Said(ClosedForm):
    """A member whose rows left out are all of one value."""

    fit = predict = state = restore = lambda *unused: None

    def __init__(self, level: float) -> None:
        self.level = level

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        return LeftOutRows(np.arange(3), torch.full((3, 1, 2), self.level), torch.ones(3))


def test_what_members_disagree_about_was_in_no_left_out_variance():
    """It is in that of predictions: weights and places were judged by variances
    that were too small.
    """
    both = Channels()
    both.members, both.weights = [Said(1.0), Said(3.0)], (0.5, 0.5)
    left = both.left_out()
    assert (left.mean == 2).all() and (left.variance == 2).all(), "1 of each, and 1 between them"
