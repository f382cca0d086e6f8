"""A station whose level steps is another one from there on; nothing else changes."""

import numpy as np
import pytest

from gsparc.data.schema import Measurements
from gsparc.data.selection import Selection
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw


def wide(**more: np.ndarray) -> Raw:
    """12 places, stations a and b; b was off at row 3."""
    rng = np.random.default_rng(0)
    rssi = rng.normal(-60, 5, (12, 2))
    rssi[3, 1] = np.nan
    arrays = {
        "rx_position": rng.uniform(0, 9, (12, 3)),
        "station_position": np.array([[0.0, 0, 3], [9, 9, 3]]),
        "station_name": np.array(["a", "b"]),
        "rssi_db": rssi,
        **more,
    }
    return Raw(arrays, {}, {})


def parted(raw: Raw, steps: dict[str, tuple[int, ...]], **settings) -> Measurements:
    return interpret(raw, "file", Selection(level_steps=steps, **settings)).data


def links(data: Measurements) -> list[tuple[str, float]]:
    """(station, power) of every row."""
    level = 10 * np.log10(data.target[:, 0] * data.site.target_scale)
    names = data.site.stations.name
    return [(names[t], round(float(v), 3)) for t, v in zip(data.station, level, strict=True)]


@pytest.mark.parametrize("who", ["b", "1"])
def test_rows_after_a_step_are_another_stations(who):
    parts = links(parted(wide(), {who: (5, 8)}))
    names = [name for name, _ in parts]
    assert [names.count(n) for n in ("a", "b", "b from row 5", "b from row 8")] == [12, 4, 3, 4]
    assert sorted(v for _, v in parts) == sorted(v for _, v in links(parted(wide(), {})))
    after = wide().arrays["rssi_db"][5:8, 1]
    assert [v for n, v in parts if n == "b from row 5"] == [round(float(v), 3) for v in after]


def test_a_part_stays_censored_where_it_heard_nothing_and_only_there():
    """Columns filled up with NaN would be rows where nothing was heard."""
    data = parted(wide(sensitivity_db=np.array(-90.0)), {"b": (5,)})
    assert (
        data.censored.sum() == 1
        and data.site.stations.name[data.station[data.censored > 0][0]] == "b"
    )


def unplaced() -> Raw:
    return Raw({"rx_position": np.eye(4)[:, :3], "tx_position": np.ones(3), "rssi_db": np.zeros(4)})


@pytest.mark.parametrize(
    ("make", "steps", "says"),
    [
        (wide, {"c": (5,)}, "no station c in file"),
        (wide, {"b": (12,)}, "expected a row between 1 and 11"),
        (wide, {"b": (0,)}, "expected a row between 1 and 11"),
        (unplaced, {"b": (2,)}, "has no stations"),
    ],
)
def test_a_step_that_cannot_be_is_one_line(refused, make, steps, says):
    refused(says, parted, make(), steps)
