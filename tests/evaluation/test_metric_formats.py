"""How figures of merit are shown and compared."""

from typing import get_args

import pytest
import torch

from gsparc.data.schema import Scored
from gsparc.evaluation.metric_formats import (
    DECIDING,
    FIGURES,
    OF_KIND,
    lower_is_better,
    score_heading,
    score_of,
)
from gsparc.evaluation.metrics import METRICS

OF_ANOTHER = {"ssim_median", "snr_db_p10", "snr_db_p50", "snr_db_p90"}  # quantiles of a figure with an entry


def figure_names(kind):
    shape = {"spectrum": (1, 16, 16), "rssi": (1, 1)}.get(kind, (1, 1, 2))
    one = torch.ones(shape, dtype=torch.complex64 if "csi" in kind else torch.float32)
    metric = METRICS[kind]()
    metric.update(one, one)
    return set(metric.summary(metric.compute())) - {"samples", "silent_samples"}


@pytest.mark.parametrize("kind", OF_KIND)
def test_every_figure_has_an_entry(kind):
    assert figure_names(kind) - OF_ANOTHER <= set(FIGURES)
    figures = OF_KIND[kind]
    assert {*figures.columns, figures.second} <= figure_names(kind) and figures.of_sample in FIGURES


def test_every_figure_knows_which_way_is_better():
    """The validation error of channels did not: the report called the worst moment of a training its best."""
    larger = {"psnr_db", "snr_db", "ssim", "ssim_gauss", "ssim_padded", "skill"} | OF_ANOTHER
    larger |= {"psnr_db_median", "ssim_gauss_median"}
    for name in {"skill", *(name for kind in DECIDING for name in figure_names(kind))}:
        assert lower_is_better(name) == (name not in larger), name
        assert (score_of(name, 0.2) > score_of(name, 0.1)) == (name in larger), name


def test_channels_that_are_scored_after_their_freedom_had_no_table():
    """`gsparc compare` and reports of Wi-Fi channels ended in a KeyError."""
    scored = set(get_args(Scored))
    assert set(OF_KIND) == set(METRICS) == scored
    assert all(score_heading(DECIDING[one]) for one in scored)
