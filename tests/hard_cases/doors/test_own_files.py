"""Files of one's own, npz and HDF5, every array spoilt in every way: `gsparc check` and `load_own`.

Remedy: gsparc/tables/own_checks.py; damage and Python objects: gsparc/tables/raw.py.
"""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from doors import assert_found_bad, knock

from gsparc.base.errors import DataError
from gsparc.commands.check import main as check
from gsparc.tables.own import load_own

Arrays = dict[str, np.ndarray]


def channels() -> Arrays:
    """Every array that goes with channels, all sound."""
    rng, rows = np.random.default_rng(0), 12
    return {
        "rx_position": rng.uniform(0, 3, (rows, 3)),
        "tx_position": np.array([4.0, 1.0, 2.0]),
        "csi": rng.normal(size=(rows, 2, 3)) + 1j * rng.normal(size=(rows, 2, 3)),
        "frequency_hz": np.array([2.40e9, 2.41e9, 2.42e9]),
        "carrier_hz": np.array(2.41e9),
        "array_position": np.array([[0.0, 0, 0], [0.06, 0, 0]]),
        "rx_orientation": np.array([1.0, 0, 0, 0]),
        "mask": np.ones((rows, 2, 3), dtype=bool),
        "noise_variance": np.full(rows, 0.01),
        "path_offsets": np.arange(rows + 1),
        "path_direction": np.tile([0.0, 0.6, 0.8], (rows, 1)),
        "split_train": np.arange(8),
        "split_test": np.arange(8, 12),
        "row_name": np.array([f"Größe {i} 米" for i in range(rows)]),
    }


def spectra() -> Arrays:
    """Every array that goes with spectra, all sound."""
    rng = np.random.default_rng(0)
    return {
        "rx_position": np.array([4.0, 1.0, 2.0]),
        "tx_position": rng.uniform(0, 3, (10, 3)),
        "spectrum": rng.uniform(0, 1, (10, 9, 36)),
        "grid_deg": np.array([0.0, 0, 10, 10]),
    }


def first(value: object) -> Callable[[np.ndarray], np.ndarray]:
    """Its first number replaced."""

    def spoil(array: np.ndarray) -> np.ndarray:
        made = np.array(array, dtype=np.result_type(array, np.float64))
        made[(0,) * made.ndim] = value
        return made

    return spoil


WAYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "nan": first(np.nan),
    "infinite": first(-np.inf),
    "1e38": first(1e38),
    "negative": lambda a: -np.abs(a) - 1 if a.dtype.kind != "b" else -a.astype(int),
    "empty": lambda a: a[..., :0] if a.ndim else np.zeros(0),
    "one more axis": lambda a: a[..., None] if a.ndim else a[None, None],
    "one row more": lambda a: np.concatenate([a, a[-1:]]) if a.ndim else np.repeat(a, 2),
    "transposed": lambda a: a.T if a.ndim > 1 else np.stack([a.reshape(-1)] * 5),
    "text": lambda a: np.full(a.shape, "three", dtype="U5"),
    "complex": lambda a: a + 1j,
    "times": lambda a: np.full(a.shape, np.datetime64("2026-01-01")),
    "a record": lambda a: np.zeros(a.shape, dtype=[("x", "f8"), ("y", "f8")]),
    "huge integers": lambda a: np.full(a.shape, 2**63, dtype=np.uint64),
}
LEFT_OUT = {  # a place of the end that moves, of few rows: they go, with a warning
    (kind, name, way)
    for kind, name in (("channels", "rx_position"), ("spectra", "tx_position"))
    for way in ("nan", "infinite", "1e38")
}
HARMLESS = {  # what these mean is clear, or they say nothing about the measurement
    *(("csi", way) for way in ("1e38", "complex", "negative", "one more axis")),
    *(("noise_variance", way) for way in ("1e38", "huge integers")),
    *(("path_direction", way) for way in ("1e38", "negative", "huge integers")),
    *(("rx_position", way) for way in ("negative",)),
    *(("tx_position", way) for way in ("negative",)),
    ("array_position", "negative"),
    *(("spectrum", way) for way in ("1e38", "one more axis")),
}


def cases() -> list[tuple[str, str, str]]:
    """(kind, array, way) of everything that must be refused."""
    sound = {"channels": channels(), "spectra": spectra()}
    return [
        (kind, name, way)
        for kind, arrays in sound.items()
        for name in arrays
        for way in WAYS
        if name != "row_name" and (name, way) not in HARMLESS and (kind, name, way) not in LEFT_OUT
    ]


def store(path: Path, arrays: Arrays) -> Path:
    """As a user would, without our writer."""
    if path.suffix == ".npz":
        np.savez(path, **arrays)
        return path
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                array = array.astype(h5py.string_dtype())
            file.create_dataset(name, data=array.astype("i8") if array.dtype.kind == "M" else array)
    return path


@pytest.mark.parametrize("suffix", ["npz", "h5"])
@pytest.mark.parametrize("kind", ["channels", "spectra"])
def test_the_sound_ones_are_read(tmp_path, kind, suffix):
    """Or else every refusal below would be for the wrong reason."""
    path = store(
        tmp_path / f"größe 米.{suffix}", {"channels": channels, "spectra": spectra}[kind]()
    )
    answer = knock(lambda: check([str(path)]), "check", [])
    assert answer.status == 0 and answer.out[-1].endswith("good")


@pytest.mark.parametrize("kind,name,way", cases(), ids=str)
def test_every_array_spoilt_in_every_way(tmp_path, kind, name, way):
    arrays = {"channels": channels, "spectra": spectra}[kind]()
    arrays[name] = WAYS[way](arrays[name])
    path = store(tmp_path / "spoilt.npz", arrays)
    assert_found_bad(knock(lambda: check([str(path)]), "check", []), rf"spoilt\.npz(, {name}|: )")
    with pytest.raises(DataError) as refused:
        load_own(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name,way", sorted(HARMLESS))
def test_what_is_not_refused_is_finite(tmp_path, name, way):
    arrays = channels() if name in channels() else spectra()
    arrays[name] = WAYS[way](arrays[name])
    try:
        data = load_own(store(tmp_path / "odd.npz", arrays))
    except DataError as refused:
        assert "\n" not in str(refused)
        return
    assert np.isfinite(data.target).all() and np.isfinite(data.tx).all()
    assert np.isfinite(data.rx_position).all()


@pytest.mark.parametrize("unit", ["mm", "cm", "km", "feet"])
def test_units_that_say_another_length(tmp_path, unit):
    path = store(tmp_path / "units.h5", channels())
    with h5py.File(path, "a") as file:
        file["rx_position"].attrs["units"] = unit
    assert_found_bad(
        knock(lambda: check([str(path)]), "check", []), f"units are '{unit}'; expected 'm'"
    )
