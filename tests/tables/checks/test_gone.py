"""A site that was off in a second drive, joined to the first."""

from dataclasses import replace

import numpy as np
import pytest
from networks import draw_network

from gsparc.base.errors import Severe
from gsparc.datasets.campaign import find_implausible
from gsparc.tables.checks.gone import find_gone


@pytest.mark.parametrize("buildings", [False, True])
def test_a_site_that_was_off_in_a_second_drive_was_learned_as_weak_without_a_word(buildings):
    one = draw_network(100, 0, 1000, 10, buildings)

    def said(measured):
        data = replace(one, measured=measured).data(6)
        warnings = [text for text in find_implausible(data, None)[0] if "in no list from" in text]
        return warnings, data.site.stations.name

    assert not said(one.measured)[0] and not said(one.measured[::-1])[0]
    off = one.measured.copy()
    off[600:, [3, 4, 5]] = -400.0
    (text,), names = said(off)
    assert isinstance(text, Severe) and set(text.split(": in no list")[0].split(", ")) <= {
        names[t] for t in (3, 4, 5)
    }


def test_a_station_that_the_drive_left_is_not_gone():
    """A street there and back, where one station is heard in the first half alone."""
    x = np.r_[np.arange(300.0), 299.5 - np.arange(300.0)]
    place, level = np.c_[x, np.zeros(600)], np.tile([-80.0, -70.0, -100.0], (600, 1))
    level[x > 150, 1] = np.nan
    assert find_gone(level, place, 10.0) == {}
    off = level.copy()
    off[450:, 0] = np.nan
    assert find_gone(off, place, 10.0) == {0: 450}
    # Without a second pass nothing tells how alike lists of two passes are.
    assert find_gone(off[300:], place[300:], 10.0) == {}
