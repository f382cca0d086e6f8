"""Discs about placed fingerprints hold the share of places that they promise."""

import numpy as np
from access_points import invented, rows_of

from gsparc.apps.locate.fingerprints import as_snapshots, left_out, reach
from gsparc.apps.locate.neighbours import located_by


def test_a_disc_holds_the_promised_share_of_other_rows():
    known, heard = rows_of(*invented(300)), rows_of(*invented(200, seed=1))
    errors = left_out(known, "random", (1.0, 0.2), 3, seed=0)
    place, *_ = located_by("weighted_knn", as_snapshots(known), as_snapshots(heard))
    inside = np.linalg.norm(place - heard.position, axis=1) <= reach(errors, 0.8)
    assert 0.72 < inside.mean() < 0.88


def test_too_few_errors_promise_nothing():
    assert reach(np.arange(9.0), 0.9) == 8.0 and reach(np.arange(8.0), 0.9) is None
