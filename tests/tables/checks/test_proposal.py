"""The split that `gsparc check` proposes can be cut,
and asks about holes wider than the places are apart.
"""

import numpy as np
from invented import divide, invent

from gsparc.datasets.describe import (
    held_out_block_rows,
    propose_side,
    propose_split,
    spacing_words,
    summarise,
)
from gsparc.tables.own import load_own, write_own


def powers(file, places):
    write_own(
        file,
        {
            "rx_position": places,
            "tx_position": np.zeros(3),
            "rssi_db": np.linspace(-80, -40, len(places)),
        },
    )
    return load_own(file)


def test_squares_are_a_tenth_of_the_site_or_several_neighbours_wide(tmp_path):
    rng = np.random.default_rng(0)
    data = powers(tmp_path / "a.npz", rng.uniform([0, 0, 1], [270, 200, 1], (400, 3)))
    assert propose_side(data) == 30.0
    assert 0.15 < len(held_out_block_rows(data, 30.0)) / 400 < 0.5
    assert "split=blocks split.side_m=30 " in propose_split(data)
    sparse = powers(
        tmp_path / "b.npz",
        np.array([[x, y, 1.0] for x in range(0, 60, 10) for y in range(0, 60, 10)]),
    )
    assert propose_side(sparse) is None and "too few places" in propose_split(sparse)


def test_copies_of_places_were_neighbours_at_no_distance(tmp_path):
    """Seen from above as well: squares of floor of places at two heights had no least side."""
    places = np.array(
        [[x, y, z] for x in range(0, 60, 10) for y in range(0, 60, 10) for z in (1.0, 2.0)]
    )
    assert spacing_words(np.repeat(places[::2], 3, axis=0), None).startswith(
        "the nearest other place is 10 m"
    )
    assert propose_side(powers(tmp_path / "a.npz", places)) is None


def test_one_place_alone_has_no_squares(tmp_path):
    data = powers(
        tmp_path / "a.npz", np.tile([1.0, 2.0, 3.0], (5, 1)) + [[0, 0, 0.1 * i] for i in range(5)]
    )
    assert propose_side(data) is None


def test_rows_of_folds_were_told_as_a_sum_over_them():
    """Of 160 spectra in five folds a run said that 560 train."""
    said = dict(summarise(invent(rows=160), divide(160, 5)))["split"]
    assert said.endswith(": each of 5 folds has about 125 training, 3 validation and 32 test rows")
