"""The plain process as one of the solutions that are weigh_candidates."""

import numpy as np
from boxes import room_of_spectra
from closed import fitted_to

from gsparc.data.inner_folds import cut_inside
from gsparc.data.splits import Fold
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.mixture.fit_candidates import weigh_candidates


def test_sources_of_few_rows_lost_a_decibel_to_the_process():
    """Bearings of a moving array were weigh_candidates against nothing."""
    data = room_of_spectra()
    few = np.arange(0, 24)
    good, _ = fitted_to(GaussianProcess(), data, few)
    spoilt, _ = fitted_to(GaussianProcess(), data, few)
    spoilt.mean = spoilt.mean + 0.3
    fold = Fold(few, np.arange(24, 40), np.arange(40, 60))
    cut = cut_inside(data, fold, None, 3, 0)
    assert [*weigh_candidates({"bearings": spoilt, "process": good}, data, fold, cut)] == ["process"]
