"""Rows with factors of their own: what is told of them up to these, and the carrier's phase."""

from dataclasses import replace

import numpy as np
import packets
import pytest

from gsparc.data.moments import Snapshots
from gsparc.data.schema import Stations
from gsparc.models import aligned_rows, fitting
from gsparc.models.aligned_rows import align_phases, align_rows
from gsparc.models.gsparc import Gsparc
from gsparc.physics.row_factors import align_factors
from gsparc.runs.align_site import align_to_site
from gsparc.tables.checks.coherence import set_unknown_factor
from gsparc.training.context import FitContext


@pytest.fixture(scope="module")
def logged():
    given, channel = packets.robot()
    del given["run"]
    tones = given["frequency_hz"] - given["frequency_hz"].mean()
    return set_unknown_factor(
        packets.measurements(given, packets.logged(channel, tones, 0)), "auto"
    )


def test_rows_that_are_coherent_stay_as_they_are():
    data = packets.measurements(*packets.robot())
    assert set_unknown_factor(data, "auto") is data
    assert align_phases(data, packets.shares(data, 0))[0] is data


def test_antennas_at_known_places_bring_the_carriers_phase_back():
    """A phase of each row's own before 12 antennas:
    phases over places come back but for one of all rows.
    """
    draw, wavelength = np.random.default_rng(0), 0.326
    places = np.c_[draw.uniform(0, 1.0, (150, 2)), np.full(150, 0.8)]
    antennas = np.c_[draw.uniform(-3, 4, (12, 2)), np.full(12, 2.4)]
    sources = np.concatenate([antennas, antennas * [1, 1, -1]])
    path = np.linalg.norm(places[:, None] - sources, axis=2).reshape(150, 2, 12)
    channel = (np.array([1.0, 0.4])[:, None] * np.exp(-2j * np.pi * path / wavelength) / path).sum(
        1
    )
    phase = np.exp(2j * np.pi * draw.uniform(size=150))
    site = replace(
        _site(), carrier_hz=299792458 / wavelength, array=antennas, static_position=np.zeros(3)
    )
    rows = Snapshots(
        np.arange(150),
        np.arange(150),
        np.zeros(150, int),
        np.zeros(1, int),
        places,
        (channel * phase[:, None])[..., None],
        np.zeros(1),
        np.zeros(150, int),
    )
    found = align_rows(rows, "phase", site)
    left = found.factors[:, 0] * phase
    assert found.phase_reference == "carrier" and abs(left.mean()) > 0.95


def _site():
    site = packets.measurements(*packets.robot()).site
    return replace(site, static_end="rx", rx_rotation=np.eye(3))


def test_stations_that_are_missing_took_the_places_of_others():
    """The direct wave of the second and third station was that of the first and second."""
    stations = Stations(np.c_[np.arange(6.0), np.zeros(6), np.full(6, 2.0)], tuple("abcdef"))
    site = replace(_site(), stations=stations, static_position=None)
    rows = Snapshots(
        np.arange(10),
        np.repeat([0, 1], 5),
        np.tile(np.arange(5), 2),
        np.arange(1, 6),
        np.ones((2, 3)),
        np.ones((2, 5, 1), complex),
        np.zeros(1),
        np.zeros(2, int),
    )
    away = np.linalg.norm(np.ones(3) - stations.position[1:], axis=1)
    expected = np.exp(-2j * np.pi / site.wavelength * away)
    assert np.allclose(aligned_rows._direct_wave(rows, site)[0, :, 0], expected)


def test_errors_of_positions_of_such_rows_ended_in_an_error(logged, caplog):
    fold = packets.shares(logged, 0)
    method, _ = fitting.fit_or_resume(Gsparc(position_std=0.001), logged, fold, FitContext())
    assert "position_std is not used" in caplog.text
    assert method.predict(logged.batch(fold.test)).mean.isfinite().all()


def test_another_file_is_scored_after_the_unknown_factor_of_the_model(logged):
    few = logged.subset(np.arange(8), replace(logged.site, unknown_factor="none"))
    assert align_to_site(few, logged.site).site.unknown_factor == "phase+delay"


@pytest.mark.slow
def test_packets_of_one_place_are_averaged(logged):
    """Twelve packets of each place were rows of one process: `gp` of a corridor had .665,
    of means .534.
    """
    draw, tones = np.random.default_rng(0), logged.site.subcarriers_hz
    row = np.repeat(np.arange(len(logged)), 4)
    shape, level = (len(row), 1, len(tones), 2), 0.3 * np.abs(logged.target).mean()
    own = logged.subset(row, logged.site).target
    phase = draw.uniform(size=(len(row), 1)) + draw.uniform(0, 50e-9, (len(row), 1)) * tones
    packet = (own + level * draw.normal(size=shape) @ [1, 1j]) * np.exp(2j * np.pi * phase)[:, None]
    several = replace(logged.subset(row, logged.site), target=packet.astype(np.complex64))
    fold = packets.shares(several, 0, side=0.1)
    turned, rows = align_phases(several, fold)
    assert len(rows.train) == len(np.unique(row[fold.train])) and (rows.test == fold.test).all()
    mean, own = turned.target[rows.train], own[rows.train]
    missed = own - mean * align_factors(mean, own, tones, "phase+delay")[:, None]
    assert (np.abs(missed) ** 2).sum() < 0.09 * (np.abs(own) ** 2).sum()  # of one packet .18


def test_one_row_of_a_station_has_nothing_to_be_turned_to(logged):
    """The nearest others of a row alone were an IndexError."""
    found = align_rows(Snapshots.from_rows(logged, np.arange(1)), "phase+delay", logged.site)
    assert found.factors.shape == (1, logged.target.shape[2]) and (found.factors == 1).all()
    with pytest.raises(ValueError, match="to=taps: channels are known up to a phase and a delay"):
        logged.site.need_phase("to=taps")
