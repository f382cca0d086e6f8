"""Rows with factors of their own: what is told of them after the same freedom, and the carrier's gauge."""

from dataclasses import replace

import numpy as np
import packets
import pytest

from gsparc.data.checks.coherence import allowed
from gsparc.data.moments import Snapshots
from gsparc.models.aligned_rows import align, in_one_gauge
from gsparc.physics.row_factors import turning

pytestmark = pytest.mark.skipif(not packets.FOLDER.exists(), reason="../shared/data is not here")


@pytest.fixture(scope="module")
def logged():
    given, channel = packets.robot()
    del given["run"]
    tones = given["frequency_hz"] - given["frequency_hz"].mean()
    return allowed(packets.measurements(given, packets.logged(channel, tones, 0)), "auto")


def test_neighbours_are_alike_after_alignment_and_test_rows_are_not_looked_at(logged):
    fold = packets.shares(logged, 0)
    aligned = in_one_gauge(logged, fold)
    assert aligned.site.gauge == "free" and aligned.site.freedom == "phase+delay"
    assert (aligned.target[fold.test] == logged.target[fold.test]).all()
    assert np.allclose(np.abs(aligned.target), np.abs(logged.target), rtol=1e-4)
    other = np.array(logged.target)
    other[fold.test] = 0
    again = in_one_gauge(replace(logged, target=other), fold)
    assert (again.target[fold.train] == aligned.target[fold.train]).all()
    assert in_one_gauge(aligned, fold) is aligned


def test_rows_that_are_coherent_stay_as_they_are():
    data = packets.measurements(*packets.robot())
    assert allowed(data, "auto") is data
    assert in_one_gauge(data, packets.shares(data, 0)) is data


def test_antennas_at_known_places_leave_the_carriers_gauge():
    """A phase of each row's own before 12 antennas: phases over places come back but for one of all rows."""
    draw, wavelength = np.random.default_rng(0), 0.326
    places = np.c_[draw.uniform(0, 1.0, (150, 2)), np.full(150, 0.8)]
    antennas = np.c_[draw.uniform(-3, 4, (12, 2)), np.full(12, 2.4)]
    sources = np.concatenate([antennas, antennas * [1, 1, -1]])
    path = np.linalg.norm(places[:, None] - sources, axis=2).reshape(150, 2, 12)
    channel = (np.array([1.0, 0.4])[:, None] * np.exp(-2j * np.pi * path / wavelength) / path).sum(1)
    phase = np.exp(2j * np.pi * draw.uniform(size=150))
    site = replace(_site(), carrier_hz=299792458 / wavelength, array=antennas, static_position=np.zeros(3))
    rows = Snapshots(
        np.arange(150), np.arange(150), np.zeros(150, int), places, (channel * phase[:, None])[..., None],
        np.zeros(1), np.zeros(150, int),
    )  # fmt: skip
    found = align(rows, "phase", site)
    left = found.factors[:, 0] * phase
    assert found.gauge == "carrier" and abs(left.mean()) > 0.95


def _site():
    site = packets.measurements(*packets.robot()).site
    return replace(site, static_end="rx", rx_rotation=np.eye(3))


def test_a_free_gain_is_a_unit_row(logged):
    free = replace(logged, site=replace(logged.site, freedom="phase+delay+gain"))
    fold = packets.shares(free, 0)
    target = in_one_gauge(free, fold).target[fold.train]
    assert np.ptp(np.abs(target).mean((1, 2))) < 0.5 * np.ptp(np.abs(free.target[fold.train]).mean((1, 2)))
    told = turning(target, target * 2, np.zeros(target.shape[2]), "phase+delay+gain")
    assert np.allclose(np.abs(told), 2, rtol=1e-3)
