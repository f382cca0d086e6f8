"""Files whose bytes are damaged: cut short, overwritten,
made to hang or crash the library that reads them.

Remedy: gsparc/base/archives.py; text of variable length is first read by a program of its own, for
a bounded time. Found: damage in a global heap of HDF5 that hangs or crashes libhdf5.
"""

import random
from pathlib import Path

import h5py
import numpy as np
import pytest

from gsparc.base import archives
from gsparc.base.errors import DataError
from gsparc.tables.own import load_own


def users_file(path: Path) -> Path:
    """As h5py writes text by itself: of variable length, in a global heap."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file["rx_position"], file["tx_position"] = (
            rng.uniform(0, 3, (12, 3)),
            np.array([4.0, 1.0, 2.0]),
        )
        file["csi"], file["frequency_hz"] = rng.normal(size=12) + 1j, 2.4e9
        file["row_name"] = [f"Raum {i}" for i in range(12)]
        file.attrs["name"] = "garage"
        file.attrs["note"] = "by hand " * 40
    return path


def test_variable_length_text_is_read(tmp_path):
    data = load_own(users_file(tmp_path / "mine.h5"))
    assert data.site.name == "garage" and data.row_names[3] == "Raum 3"


@pytest.mark.parametrize(
    "count", [pytest.param(5, id="few"), pytest.param(40, id="many", marks=pytest.mark.slow)]
)
def test_damaged_heaps_are_read_or_refused_in_bounded_time(tmp_path, count):
    good = users_file(tmp_path / "good.h5").read_bytes()
    heap = good.index(archives.HEAP)
    for seed in range(count):
        draw, spoilt = random.Random(seed), bytearray(good)
        for _ in range(3):
            spoilt[heap + 4 + draw.randrange(60)] = draw.choice([0, 1, 255, draw.randrange(256)])
        path = tmp_path / f"{seed}.h5"
        path.write_bytes(spoilt)
        try:
            load_own(path)
        except DataError as refused:
            assert "\n" not in str(refused) and path.name in str(refused)


def test_a_reader_that_hangs_or_crashes_is_told_apart(tmp_path, monkeypatch):
    path = users_file(tmp_path / "mine.h5")
    monkeypatch.setattr(archives, "READ", "import time; time.sleep(60)")
    assert "cannot be read in 0.5 s" in str(archives.hdf5_text_error(path, seconds=0.5))
    monkeypatch.setattr(archives, "READ", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(DataError, match=r"mine\.h5: damaged \(its text crashes the HDF5 library\)"):
        load_own(path)


def test_a_heap_that_makes_libhdf5_loop_is_refused(tmp_path, monkeypatch):
    """Found by fuzzing: an object that says it is 2 kB larger is walked past for ever."""
    spoilt = bytearray(users_file(tmp_path / "good.h5").read_bytes())
    spoilt[spoilt.index(archives.HEAP) + 25] = 8  # second byte of the first object's size
    path = tmp_path / "loops.h5"
    path.write_bytes(spoilt)
    monkeypatch.setattr(archives.hdf5_text_error, "__defaults__", (1.0,))
    with pytest.raises(DataError, match=r"loops\.h5: damaged \(its text cannot be read in 1 s\)"):
        load_own(path)
