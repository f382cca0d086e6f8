"""Sites at places that their levels contradict; sites where they are stated."""

import re
from dataclasses import replace

import numpy as np
import pytest
from level_fields import fields, flight
from networks import network

from gsparc.tables.advice import run_warnings
from gsparc.tables.checks.level_steps import LinkLevels, link_levels
from gsparc.tables.checks.plausibility import misplaced_warnings
from gsparc.tables.own import from_arrays

CITIES = {seed: link_levels(network(seed).data(6)) for seed in range(3)}


def moved(levels: LinkLevels, how) -> list[str]:
    """Warnings where the sites (K, 3) of a network stand elsewhere."""
    sites, of = np.unique(levels.station_position, axis=0, return_inverse=True)
    return misplaced_warnings(replace(levels, station_position=how(sites)[of.reshape(-1)]))


@pytest.mark.parametrize("seed", CITIES)
def test_a_list_of_sites_joined_to_rotated_names_was_good(seed):
    (said,) = moved(CITIES[seed], lambda sites: np.roll(sites, 1, axis=0))
    assert said.startswith("levels fall with distance from places of other stations, ")
    assert said.endswith("are names or places exchanged?")


@pytest.mark.parametrize("seed", [1, 2])  # of six cities five are told; beams point away from sites
def test_a_list_of_sites_about_another_origin_was_good(seed):
    (said,) = moved(CITIES[seed], lambda sites: np.add(sites, [400, -300, 0]))
    assert re.match(
        r"levels of all 10 sites fall with distance from places \(-\d{3}, \+\d{3}\) m beside", said
    )


def runs(moves: bool) -> list[str]:
    """Warnings of powers of one transmitter on three days,
    which stood elsewhere on each where it `moves`.
    """
    place, level = fields(0, 3)
    run = np.arange(len(place)) % 3
    level = np.where(moves, level[np.arange(len(place)), run], level[:, 0])
    level = level + np.random.default_rng(0).normal(0, 2, len(place))
    heights = np.full(len(place), 1.5)
    arrays = {
        "rx_position": np.c_[place, heights],
        "tx_position": np.ones(3),
        "rssi_db": level,
        "run": run,
    }
    return run_warnings(from_arrays(arrays))


def test_a_transmitter_that_moved_between_runs_was_good():
    (said,) = runs(True)
    assert (
        said.startswith("runs: levels left out are predicted to ")
        and "did what stands still move between them?" in said
    )
    assert not runs(False)


@pytest.mark.parametrize("seed", CITIES)
def test_places_that_levels_bear_out_are_not_doubted(seed):
    assert not misplaced_warnings(CITIES[seed])
    assert not misplaced_warnings(link_levels(from_arrays(flight(seed))))
