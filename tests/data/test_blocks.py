"""Measurements too large for memory: read from where they are, block by block,
and the same as in memory.
"""

import multiprocessing
import pickle
import zipfile

import h5py
import numpy as np
import pytest
from opened import say

from gsparc.data import blocks
from gsparc.data.schema import Measurements, Site
from gsparc.datasets.own import read_any
from gsparc.tables import array_sizes
from gsparc.tables.checks.constant import leave_out_unmeasured, mark_constants
from gsparc.tables.own import load_own, write_own


def arrays(rows: int = 40) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "rx_position": rng.uniform(0, 5, (rows, 3)),
        "tx_position": np.array([9.0, 0, 2]),
        "csi": (rng.normal(size=(rows, 4, 8)) + 1j * rng.normal(size=(rows, 4, 8))).astype(
            np.complex64
        ),
        "frequency_hz": 3.5e9 + 1e6 * np.arange(8),
    }


@pytest.fixture
def small(monkeypatch):
    """A kilobyte is big, and half of it a block."""
    monkeypatch.setattr(blocks, "BIG", 1024)
    monkeypatch.setattr(blocks, "BLOCK", 512)


def spectra(kind) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    values = (
        rng.uniform(0, 3, (20, 12, 16))
        if kind is not np.uint8
        else rng.integers(0, 256, (20, 12, 16))
    )
    places = {"rx_position": rng.uniform(0, 5, (20, 3)), "tx_position": np.array([9.0, 0, 2])}
    return {**places, "spectrum": values.astype(kind)}


def unchunked(path, values):
    with h5py.File(path, "w") as file:
        for name, one in values.items():
            file[name] = one


def test_tones_that_are_zero_in_a_block_alone_were_not_measured_there(small):
    values = arrays()["csi"]
    values[:4, :, 2], values[:, :, 5] = 0, 0
    site = Site("room", "csi", "rx", None, None, None, arrays()["frequency_hz"])
    places = np.random.default_rng(0).random((40, 3))
    data = Measurements(site, places, 0 * places, np.zeros((40, 3, 3)), values)
    kept = leave_out_unmeasured(mark_constants(data, []))
    assert kept.site.measured[:, [2, 5]].tolist() == [[True, False]] * len(kept.site.measured)
    np.testing.assert_array_equal(kept.target, np.delete(values, 5, 2))


@pytest.mark.parametrize("write", [write_own, unchunked])
@pytest.mark.parametrize("kind", [np.complex64, np.uint8, np.float32, np.float64])
def test_measurements_stay_on_disk_and_are_the_same(tmp_path, small, monkeypatch, kind, write):
    """Spectra of floating point were three copies in memory,
    of a byte a mask as large as they are.
    """
    path = tmp_path / "own.h5"
    write(path, arrays() if kind is np.complex64 else spectra(kind))
    there = load_own(path)
    with monkeypatch.context() as patch:
        patch.setattr(blocks, "BIG", 2**28)
        here = load_own(path)
    assert isinstance(there.target, np.memmap) and not isinstance(here.target, np.memmap)
    assert there.target.dtype == here.target.dtype and np.array_equal(there.target, here.target)
    assert (
        there.site.sha256 == here.site.sha256 and there.site.target_scale == here.site.target_scale
    )
    rows = np.array([7, 3, 3, 19])
    assert np.array_equal(there.batch(rows).target, here.batch(rows).target)


def test_a_process_that_is_started_opens_the_file_itself(tmp_path):
    """It got a copy of the targets through a pipe: of 100,000 channels 0.8 GB a process."""
    nameless = blocks.allocate_on_disk((3, 2), np.int16)
    nameless[:] = np.arange(6).reshape(3, 2)
    with h5py.File(tmp_path / "own.h5", "w") as file:
        file["csi"] = np.arange(5.0)
        named = blocks.map_from_disk(file["csi"])
    spawn = multiprocessing.get_context("spawn")
    arrays = (nameless, named, named[1:3])
    process = spawn.Process(target=say, args=(tmp_path / "said", *arrays))
    process.start()
    process.join(60)
    said = (tmp_path / "said").read_text().splitlines()
    assert said == [
        f"{own} {one.tolist()}" for own, one in zip((True, True, False), arrays, strict=True)
    ]
    # Elsewhere a copy, as ever
    assert np.array_equal(pickle.loads(pickle.dumps(nameless)), nameless)


def unwritten(path, rows=10**12, **more):
    """Chunks of an array that nobody wrote."""
    with h5py.File(path, "w") as file:
        for name, one in arrays().items():
            if name not in more:
                file[name] = one
        for name, kind in (more or {"csi": "c8"}).items():
            file.create_dataset(name, shape=(rows,), dtype=kind, chunks=(2**16,))
    return path


@pytest.mark.parametrize(
    ("rows", "more", "says"),
    [
        (
            10**12,
            {"csi": "c8"},
            r"csi: shape .1000000000000,., 8,000,000,000,000 bytes: a file of .* does not hold",
        ),
        (10**11, {"csi": "f4", "rx_position": "f8"}, "rx_position: shape .* does not hold that"),
        (10**11, {"row_name": h5py.string_dtype()}, "row_name: shape .* does not hold that"),
        (
            10**8,
            {f"extra{n}": "u1" for n in range(40)},
            "shape .100000000,., 100,000,000 bytes: .* does not hold",
        ),
    ],
)
@pytest.mark.parametrize("name", ["own.h5", "own.nc"])
def test_an_array_that_was_never_written_filled_the_disk(
    tmp_path, monkeypatch, refused, rows, more, says, name
):
    """A file of 7 kB: 73 GB in 8 s, until other programs died."""
    monkeypatch.setattr(
        blocks, "allocate_on_disk", lambda *unused: pytest.fail("written before it was refused")
    )
    monkeypatch.setattr(
        h5py.Dataset, "__getitem__", lambda *unused: pytest.fail("read before it was refused")
    )
    refused(says, read_any, unwritten(tmp_path / name, rows, **more))


def test_an_npz_that_inflates_without_end_took_all_memory(tmp_path, monkeypatch, refused):
    # 80 MiB in an eighth of a megabyte
    zeros = {**arrays(), "csi": np.zeros((2**18, 40), np.complex64)}
    np.savez_compressed(tmp_path / "own.npz", **zeros)
    monkeypatch.setattr(array_sizes, "BIG", 2**26)
    monkeypatch.setattr(
        np, "load", lambda *unused, **named: pytest.fail("read before it was refused")
    )
    refused("csi: shape .* no other array has .262144,. rows", load_own, tmp_path / "own.npz")
    zeros |= {"rx_position": np.zeros((2**18, 3))}
    np.savez_compressed(tmp_path / "own.npz", **zeros)
    monkeypatch.setattr(array_sizes, "machine_memory", lambda: 2**27)
    refused("csi: .* too little memory for 90,", load_own, tmp_path / "own.npz")
    with (
        zipfile.ZipFile(tmp_path / "lies.npz", "w") as archive,
        archive.open("csi.npy", "w") as entry,
    ):
        head = {"descr": "<c8", "fortran_order": False, "shape": (10**15,)}
        np.lib.format.write_array_header_1_0(entry, head)
    refused("csi: shape .* does not hold that", load_own, tmp_path / "lies.npz")


def test_a_copy_leaves_room_on_the_disk(tmp_path, small, monkeypatch, refused):
    monkeypatch.setattr(array_sizes, "SPARE", 2**60)
    monkeypatch.setattr(array_sizes, "BIG", 1024)
    with h5py.File(tmp_path / "own.h5", "w") as file:
        for name, one in arrays().items():
            file.create_dataset(name, data=one, chunks=one.ndim > 1 or None)
    refused("csi: .* has no room; set TMPDIR to a larger disk", load_own, tmp_path / "own.h5")
