"""The same command finds the same, to the bit: on one core, and beside two busy loops."""

import json
import os
import subprocess
import sys

import pytest
from releases import real

CASES = {
    "rfid": ("dataset=rfid", "dataset.root", "rfid-s23-160"),
    "an antenna": (
        "dataset=techtile",
        "dataset.file",
        "real/techtile-csi-920mhz.npz",
        "dataset.stations=[5]",
        "dataset.runs=[EXP005]",
    ),
    "the plane": (
        "dataset=techtile_power",
        "dataset.file",
        "real/techtile-power-reci-rf-1.npz",
        "dataset.max_rows=4000",
    ),
    "a station of the city": (
        "dataset=powder",
        "dataset.file",
        "real/powder-rss-462mhz.npz",
        "dataset.stations=[6]",
        "dataset.max_rows=1500",
    ),
    "a room": ("dataset=newrf", "dataset.file", "newrf-conference.npz"),
    "several antennas": (
        "dataset=techtile",
        "dataset.file",
        "real/techtile-csi-920mhz.npz",
        "dataset.stations=[1,5,9]",
        "dataset.runs=[EXP005]",
        "stations=together",
    ),
    "OFDM of runs": (
        "dataset=wsr",
        "dataset.file",
        "ofdm/wsr-los-a.npz",
        "dataset.stations=[0]",
        "dataset.max_rows=600",
    ),
    "stations of the city": (
        "dataset=powder",
        "dataset.file",
        "real/powder-rss-462mhz.npz",
        "dataset.stations=[6,7,9]",
        "dataset.max_rows=700",
        "stations=together",
    ),
}
SAME = ("model/init", "model/made", "model/steps", "model/num_gaussians")


def trained(case, folder, *before):
    """Predictions of test rows as text, and what was chosen."""
    choice, name, file, *more = CASES[case]
    words = (
        choice,
        f"{name}={real(file)}",
        *more,
        "threads=1",
        "logger=none",
        f"hydra.run.dir={folder}",
    )
    command = [*before, sys.executable, "-m", "gsparc", "train", *words]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr
    facts = json.loads((folder / "summary.json").read_text())
    rows = [
        line.rpartition(",")[0] for line in (folder / "per_sample.csv").read_text().splitlines()
    ]
    return rows, {one: facts[one] for one in SAME}  # the last column names the run


@pytest.mark.slow
@pytest.mark.rare
@pytest.mark.parametrize("case", CASES)
def test_a_busy_machine_finds_the_same(case, tmp_path):
    """A clock chose on how many rows: 5.573 dB beside two loops, 5.580 alone."""
    alone = trained(case, tmp_path / "one core", "taskset", "-c", str(min(os.sched_getaffinity(0))))
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        assert trained(case, tmp_path / "busy") == alone
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
