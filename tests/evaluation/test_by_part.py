"""A drive beside what was said: which cells, rings and areas are off."""

import numpy as np
import pytest

from gsparc.evaluation.by_part import Drive, describe_parts


def drive(off_db: float) -> Drive:
    """Two cells over 1 km; `off_db` too much is said of the second beyond 500 m."""
    rng = np.random.default_rng(0)
    place, cell = rng.uniform(0, 1000, (4000, 2)), np.arange(4000) % 2
    distance = np.linalg.norm(place, axis=1)
    error = rng.normal(0, 4, 4000) + off_db * ((cell == 1) & (distance > 500))
    error[:7] = np.nan  # refused
    return Drive(error, np.full(4000, 1.645 * 4), place, distance, cell, ["a", "b"])


def test_what_is_off_is_named_and_nothing_else():
    records = drive(6.0).judge()
    whole = records[0]
    assert whole["part"] == "all" and whole["rows"] == 3993 and whole["within"] < 0.8
    cells = {row["name"]: row for row in records if row["part"] == "cell"}
    assert abs(cells["a"]["bias_db"]) < 0.5 and cells["b"]["bias_db"] > 3
    assert cells["a"]["within"] == pytest.approx(0.9, abs=0.03)
    rings = {row["name"]: row["bias_db"] for row in records if row["part"] == "ring"}
    assert abs(rings["200 to 500 m"]) < 0.6 and rings["500 to 1000 m"] > 2
    text = " ".join(describe_parts(records, 0.9))
    assert "cell b" in text and "cell a" not in text and "surely off" in text


def test_intervals_hold_all_parts_at_once():
    """Each of forty by itself, some would be called off in every drive."""
    records = drive(0.0).judge()
    assert len(records) > 40
    assert all(row["bias_low_db"] < 0 < row["bias_high_db"] for row in records)
    assert "surely off" not in " ".join(describe_parts(records, 0.9))
