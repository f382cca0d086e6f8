"""The plain process as one of the solutions that are weighed."""

import numpy as np
import torch
from boxes import room_of_spectra

from gsparc.data.inner_folds import cut_inside
from gsparc.data.splits import Fold
from gsparc.field.initial import InitSettings
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.fields import INITIALISERS
from gsparc.models.method_field import ProcessField
from gsparc.models.mixture.solutions import weighed
from gsparc.training.context import FitContext

ROWS = np.arange(0, 160, 2)


def test_it_answers_as_the_process_does_and_is_read_back():
    data = room_of_spectra()
    field, _ = INITIALISERS["process"](data, ROWS, InitSettings(), True, FitContext())
    plain, batch = GaussianProcess(), data.batch(np.arange(1, 160, 10))
    plain.fit(data, Fold(ROWS, ROWS[:0], ROWS[:0]), FitContext())
    found, said = field(batch), plain.predict(batch)
    assert torch.equal(found.mean, said.mean) and torch.equal(found.unknown, said.unknown)
    again = ProcessField.restored(data.site, field.state())(batch)
    assert torch.allclose(again.mean, found.mean, atol=1e-6) and field.count == 0


def test_sources_of_few_rows_lost_a_decibel_to_the_process():
    """Bearings of a moving array were weighed against nothing."""
    data = room_of_spectra()
    few = np.arange(0, 24)
    good, _ = INITIALISERS["process"](data, few, InitSettings(), True, FitContext())
    spoilt, _ = INITIALISERS["process"](data, few, InitSettings(), True, FitContext())
    spoilt.method.mean = spoilt.method.mean + 0.3
    fold = Fold(few, np.arange(24, 40), np.arange(40, 60))
    cut = cut_inside(data, fold, None, 3, 0)
    assert [*weighed({"bearings": spoilt, "process": good}, data, fold, cut)] == ["process"]
