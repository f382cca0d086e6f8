"""Which station a query is of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsparc.data.schema import Stations
from gsparc.models.channels.columns import NOBODY, query_ends
from gsparc.ops import Pose


def test_the_one_station_at_an_unknown_place_was_nobody(campaign):
    here = np.array([[1.0, 2, 3], [np.nan] * 3])
    site = replace(campaign("csi", 8, "tx").site, stations=Stations(here, ("known", "unknown")))
    asked = torch.from_numpy(np.concatenate([here[::-1], here[:1] + 1]))
    *_, nearest = query_ends(site, asked, Pose(torch.zeros(3, 3), torch.eye(3).expand(3, 3, 3)))
    assert nearest.tolist() == [1, 0, NOBODY]
