"""Rows of Parquet merged by cells while they are read: the means of all of them, whatever the files."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from gsparc.data.datasets.own import Own, read_own
from gsparc.data.errors import DataError
from gsparc.data.limits import SettingError

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
CELL_M, ROWS = 5.0, 3000


@pytest.fixture
def frame():
    """A walk heard by two stations, some rows without a level."""
    rng = np.random.default_rng(0)
    walk = {"x": rng.uniform(-40, 40, ROWS), "y": rng.uniform(-40, 40, ROWS), "z": np.full(ROWS, 1.1)}
    station = rng.choice(["a", "b"], ROWS)
    there = {"station": station, "station_x": np.where(station == "a", 0.1, 90.7), "station_y": 3.3}
    level = np.where(rng.random(ROWS) < 0.02, np.nan, rng.normal(-80, 6, ROWS))
    return pd.DataFrame({**walk, **there, "station_z": 9.0, "rssi [dBm]": level, "note": "unused"})


def parts(frame: pd.DataFrame, folder, count: int):
    folder.mkdir()
    for number, rows in enumerate(np.array_split(np.arange(len(frame)), count)):
        frame.iloc[rows].to_parquet(folder / f"part-{number}.parquet", index=False)
    return folder


@pytest.mark.parametrize("count", [1, 7])
def test_cells_are_the_means_of_all_rows(frame, tmp_path, count):
    raw = read_own(parts(frame, tmp_path / "rows", count), cell_m=CELL_M)
    frame["heard"] = frame["rssi [dBm]"].notna()
    cell = [np.floor(frame[axis] / CELL_M).rename(f"of {axis}") for axis in "xyz"]
    whole = frame.groupby([*cell, "station", "heard"], sort=False).mean(numeric_only=True)
    moving = raw.arrays["rx_position"]
    np.testing.assert_allclose(moving, whole[["x", "y", "z"]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(raw.arrays["rssi_db"], whole["rssi [dBm]"], rtol=0, atol=1e-12)
    names = [str(raw.arrays["station_name"][i]) for i in raw.arrays["station"]]
    assert names == list(whole.index.get_level_values("station")) and len(names) < ROWS / 2
    assert (moving[:, 2] == 1.1).all()  # not but for rounding


def test_a_folder_a_file_and_a_url_are_the_same(frame, tmp_path):
    folder = parts(frame, tmp_path / "rows", 3)
    frame.to_parquet(tmp_path / "whole.parquet", index=False)
    every = [
        Own(file, cell_m=CELL_M).load() for file in (folder, f"file://{folder}", tmp_path / "whole.parquet")
    ]
    assert len({one.site.sha256 for one in every}) == 1 and len(every[0]) < ROWS / 2


def test_degrees_are_cells_of_metres(tmp_path):
    latitude, longitude = 60.0 + np.arange(64) * 2.5 / 111_320, 10 + np.arange(64) * 2.5 / 111_320 * 2
    rows = {"latitude": np.repeat(latitude, 64), "longitude": np.tile(longitude, 64)}
    pd.DataFrame({**rows, "rssi_db": -70.0}).to_parquet(tmp_path / "rows.parquet")
    cells = len(read_own(tmp_path / "rows.parquet", cell_m=5.0).arrays["rssi_db"])
    assert abs(cells - 32 * 32) <= 2 * 32 + 1  # a border may be cut


@pytest.mark.parametrize(("change", "cell_m", "said"), [
    ({"rssi [dBm]": "loud"}, 5.0, "damaged or not a Parquet file .*loud"),
    ({"rssi [dBm]": None, "rssi [W]": 1e-9}, 5.0, r"dataset.columns.rssi_db=COLUMN"),
    ({"x": None}, 5.0, "none is x; say"),
    ({}, 0.0, "dataset.cell_m=0.0"),
    ({}, None, "dataset.cell_m"),
])  # fmt: skip
def test_what_cannot_be_is_refused(frame, tmp_path, change, cell_m, said):
    changed = frame.assign(**{name: value for name, value in change.items() if value is not None})
    changed = changed.drop(columns=[name for name, value in change.items() if value is None])
    with pytest.raises((DataError, SettingError), match=said):
        Own(parts(changed, tmp_path / "rows", 2), cell_m=cell_m).load()


PEAK = """
import resource, sys
from gsparc.data.datasets.own import read_own
read_own(sys.argv[1], cell_m=5.0)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_rows(tmp_path):
    """7 million rows are 168 MB as numbers alone; a few hundred thousand fill the same cells."""
    rng, peak_mb = np.random.default_rng(1), []
    for count in (1, 20):
        folder = tmp_path / str(count)
        folder.mkdir()
        for part in range(count):
            rows = {"x": rng.uniform(0, 500, 350_000), "y": rng.uniform(0, 500, 350_000), "rssi_db": -70.0}
            pd.DataFrame(rows).to_parquet(folder / f"{part}.parquet", index=False)
        done = subprocess.run(
            [sys.executable, "-c", PEAK, folder], capture_output=True, text=True, check=True
        )
        peak_mb.append(float(done.stdout))
    assert peak_mb[1] - peak_mb[0] < 100
