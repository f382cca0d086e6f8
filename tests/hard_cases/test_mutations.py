"""Three hundred ways to damage each kind of file: refused in one line, or read exactly as before.

Remedy: checksums of archives (gsparc/models/checkpoint.py), of arrays and of everything together
(gsparc/tables/raw.py). Tolerance: none. Naive: HDF5 checks no scalar and no attribute, so a changed
carrier is read like a sound one.
"""

import random
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from campaigns import channels, spectra
from contexts import loaded

from gsparc.models import checkpoint, loading
from gsparc.models.registry import build
from gsparc.tables.own import load_own, write_own
from gsparc.tables.raw import read_raw
from gsparc.training.context import FitContext

TIMES, TOGETHER = 300, 50


def mutated(content: bytes, seed: int) -> bytes:
    """A few bytes flipped, zeroed, repeated, inserted, left out or swapped, or the end cut off."""
    draw, data = random.Random(seed), bytearray(content)
    for _ in range(draw.randint(1, 3)):
        at, length = draw.randrange(len(data)), draw.randint(1, 64)
        kind = draw.choice(
            ["flip", "flip", "flip", "zero", "repeat", "insert", "drop", "swap", "cut"]
        )
        if kind == "flip":
            data[at] ^= 1 << draw.randrange(8)
        elif kind == "zero":
            data[at : at + length] = bytes(len(data[at : at + length]))
        elif kind == "repeat":
            data[at:at] = data[at : at + length]
        elif kind == "insert":
            data[at:at] = draw.randbytes(length)
        elif kind == "drop":
            del data[at : at + length]
        elif kind == "swap":
            other = draw.randrange(len(data))
            data[at], data[other] = data[other], data[at]
        elif at > 0:
            del data[at:]
    return bytes(data)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """A sound file of each kind that gsparc writes."""
    folder = tmp_path_factory.mktemp("sound")
    raw = read_raw(channels(folder / "raw.npz"))
    for name in ("own.npz", "own.h5"):
        write_own(folder / name, raw.arrays, {"name": "room", "measured_by": "somebody"})
    method = build({"_target_": "gsparc.models.baselines.idw.InverseDistance"})
    method.fit(*loaded(spectra(folder / "spectra.npz")), FitContext(folder))
    checkpoint.save(folder / "idw.ckpt", method, "seed: 3\n", {"train_s": 1.5})
    return {
        path.suffix: path for path in (folder / "own.npz", folder / "own.h5", folder / "idw.ckpt")
    }


def answer(path: Path) -> list[object]:
    """Everything that is read."""
    if path.suffix == ".ckpt":
        method, stored = loading.load(path)
        state = method.state()
        parts = [
            v.numpy().tobytes() if isinstance(v, torch.Tensor) else repr(v) for v in state.values()
        ]
        return [stored.method, stored.config, repr(stored.extra), stored.site.sha256, *parts]
    data = load_own(path)
    return [data.site.sha256, data.site.name, data.row_names, repr(data.provenance)]


@pytest.mark.parametrize("first", range(0, TIMES, TOGETHER))
@pytest.mark.parametrize("suffix", [".npz", ".h5", ".ckpt"])
def test_refused_or_read_exactly_as_before(files, tmp_path, suffix, first):
    sound = files[suffix]
    content, wanted = sound.read_bytes(), answer(sound)
    path = tmp_path / sound.name
    for number in range(first, first + TOGETHER):
        path.write_bytes(mutated(content, number))
        try:
            found = answer(path)
        except ValueError as refused:  # DataError, CheckpointError
            assert "\n" not in str(refused) and len(str(refused)) < 700, number
            assert path.name in str(refused), (number, str(refused))
        else:
            assert found == wanted, number


def test_a_changed_scalar_breaks_the_naive_reading(files, tmp_path):
    path = tmp_path / "own.h5"
    path.write_bytes(files[".h5"].read_bytes())
    with h5py.File(path, "r+") as file:
        file["tx_position"][...] = np.asarray(file["tx_position"]) + 1.0
    with h5py.File(path, "r") as file:
        assert np.isfinite(file["tx_position"][()]).all()
    with pytest.raises(ValueError, match="its content is not what was written"):
        load_own(path)
    with h5py.File(path, "r+") as file:
        del file.attrs["content_sha256"]
    load_own(path)
