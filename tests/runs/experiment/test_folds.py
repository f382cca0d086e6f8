"""Folds of a split, fitted here and in other processes."""

import pytest
import torch

from gsparc.evaluation.intervals import pool_figures
from gsparc.evaluation.scores import score_methods
from gsparc.models.registry import method_class
from gsparc.runs.experiment.folds import fit_folds, fold_contexts
from gsparc.training.context import FitContext


@pytest.mark.slow
def test_folds_that_are_fitted_elsewhere_have_the_same_figures(
    campaign, folds, tmp_path, elsewhere
):
    torch.set_num_threads(1)
    data, split = campaign("spectrum", 40), folds(40, 3)
    kept = []

    def outcome():
        context = fold_contexts(FitContext(tmp_path), split)
        keep = lambda number, *unused: kept.append(number)  # noqa: E731
        fits = fit_folds(method_class("gp")(), data, split, context, keep=keep)
        return pool_figures(score_methods(fits.methods, data, split), data, split)

    here = outcome()
    elsewhere("joblib")
    there = outcome()
    assert here == there and here["psnr_db"] > 0
    assert kept[:3] == [0, 1, 2] and sorted(kept[3:]) == [0, 1, 2]
