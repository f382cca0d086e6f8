"""What few rows can tell is said before a training."""

import re

import numpy as np

from gsparc.models.powers.members import foresee_errors
from gsparc.models.target_rows import power_rows
from gsparc.prediction.foreseen import MANY, describe_few_rows
from tests.models.baselines.test_likeliest import town


def test_few_rows_say_how_far_they_lead_and_many_say_nothing():
    sentence = describe_few_rows(town(12))
    assert sentence is not None
    now, later = map(float, re.findall(r"([\d.]+) dB", sentence))
    assert 2 < later < now < 12 and sentence.startswith("with 12 rows about")
    assert describe_few_rows(town(MANY + 1)) is None


def test_the_foreseen_error_is_about_that_had():
    data = town(320, shadowing_db=6.0)
    rows = power_rows(data, np.arange(320))
    error, later = foresee_errors(rows.subset(np.arange(20)), data.site, 200)
    spread = rows.decibels.std()
    assert 0.3 * spread < error < 1.3 * spread and later < 0.9 * error
