"""Lists of the strongest: recognised, what they leave out, and levels of single rows."""

import numpy as np
import pytest
from networks import network
from releases import real

from gsparc.data.datasets.powder import read_powder
from gsparc.data.links.strongest import number_lists
from gsparc.data.own import from_arrays, interpret
from gsparc.data.raw import Raw


@pytest.mark.parametrize("count", [3, 10])
def test_lists_of_the_strongest_tell_of_what_they_leave_out(count):
    one = network(0)
    reading = interpret(Raw(one.arrays(count, azimuths=False)), "drive")
    data = reading.data
    said = [note for note in reading.notes if note.startswith(f"lists of the {count} strongest of 30")]
    silent, listed = data.censored > 0, data.censored == 0
    assert len(said) == 1 and listed.sum() == 700 * count and silent.sum() <= 2 * listed.sum()
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    place = {tuple(at): i for i, at in enumerate(one.moment.round(3))}
    moment = [place[tuple(at)] for at in (data.moving + data.site.origin).round(3)]
    truth = one.measured[moment, data.station]
    assert np.allclose(truth[listed], level[listed], atol=1e-3)
    assert (truth[silent] < level[silent] + 1e-3).all()


def test_lists_are_taken_for_none_where_nobody_wants_it():
    arrays = network(0).arrays(6)
    assert interpret(Raw(arrays, {"absent": "unknown"}), "drive").data.censored is None


def test_outages_are_no_lists():
    raw = read_powder(real("real/powder-rss-462mhz.npz"))
    assert interpret(raw, "powder").data.censored is None


def test_rows_have_levels_of_their_own():
    """A column of levels was refused, as one for all rows was expected."""
    levels = np.array([-70.0, np.nan, -75.0, np.nan, -80.0])
    floor = np.array([np.nan, -90.0, -99.0, -95.0, -99.0])
    data = from_arrays(
        {
            "rx_position": np.eye(5, 3) * 9,
            "tx_position": np.zeros(3),
            "rssi_db": levels,
            "sensitivity_db": floor,
        }
    )
    found = 10 * np.log10(data.target[data.censored > 0, 0] * data.site.target_scale)
    assert np.allclose(found, [-90, -95], atol=1e-4)


def test_moments_of_one_place():
    place, station = np.array([0, 0, 0, 0, 1, 1]), np.array([1, 2, 1, 3, 1, 2])
    assert number_lists(place, station).tolist() == [0, 0, 1, 1, 2, 2]
    apart = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2])
    assert number_lists(apart, np.repeat([1, 2, 3], 3)).tolist() == apart.tolist()
