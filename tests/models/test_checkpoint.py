"""Checkpoints: what goes in comes out; what may not come in:
tests/hard_cases/doors/test_checkpoints.py.
"""

import collections
import os
import re
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused_as
from states import same

from gsparc.base.instantiate import import_target
from gsparc.datasets.own import Own
from gsparc.models import checkpoint, loading
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.training.context import FitContext

refused = partial(refused_as, CheckpointError)


@pytest.fixture
def fitted(campaign, folds, tmp_path):
    data = campaign("spectrum", 30)
    method = GaussianProcess()
    method.fit(data, folds(30).folds[0], FitContext(tmp_path))
    return method, data.batch(folds(30).folds[0].test)


@pytest.fixture
def path(fitted, tmp_path):
    """A checkpoint."""
    checkpoint.save(tmp_path / "m.ckpt", fitted[0])
    return tmp_path / "m.ckpt"


def test_extra_keeps_its_shape(fitted, tmp_path):
    named = collections.namedtuple("Named", "a b")
    extra = {
        "optimizer": {
            "state": {0: {"step": torch.tensor(3.0)}},
            "groups": [{"lr": 1e-3, "betas": (0.9, 0.99)}],
        },
        "rng": torch.get_rng_state(),
        "numpy": np.arange(3, dtype=np.int64),
        "scalar": np.float64(0.25),
        "path": Path("a/b"),
        "none": None,
        "ordered": collections.OrderedDict(x=1),
        "tuple": named(1, 2),
    }
    checkpoint.save(tmp_path / "m.ckpt", fitted[0], extra=extra)
    back = checkpoint.read(tmp_path / "m.ckpt").extra
    assert back["optimizer"]["groups"] == [{"lr": 1e-3, "betas": (0.9, 0.99)}]
    assert back["optimizer"]["state"][0]["step"] == 3 and torch.equal(back["rng"], extra["rng"])
    assert back["scalar"] == 0.25 and back["path"] == "a/b" and back["ordered"] == {"x": 1}
    assert (
        torch.equal(back["numpy"], torch.arange(3))
        and back["tuple"] == (1, 2)
        and back["none"] is None
    )


def test_what_cannot_be_stored_is_named(fitted, path):
    before = path.read_bytes()
    refused(
        re.escape("extra.a[1] is a object"),
        checkpoint.save,
        path,
        fitted[0],
        extra={"a": [1, object()]},
    )
    assert path.read_bytes() == before
    refused("not been fitted", checkpoint.save, path, GaussianProcess())


def test_a_view_does_not_drag_its_storage_along(fitted, path):
    small = path.stat().st_size
    checkpoint.save(path, fitted[0], extra={"row": torch.zeros(1_000_000)[:10]})
    assert path.stat().st_size < small + 10_000


def test_others_may_read_a_checkpoint_as_the_umask_says(fitted, tmp_path):
    """Models were readable by their owner alone (mode 600), unlike every other file of a run."""
    before = os.umask(0o027)
    try:
        checkpoint.save(tmp_path / "m.ckpt", fitted[0])
    finally:
        os.umask(before)
    assert (tmp_path / "m.ckpt").stat().st_mode & 0o777 == 0o640


def test_an_entry_marked_as_a_folder_is_read_all_the_same(path):
    """torch took such an entry for read and answered with whatever the memory held."""
    sound = checkpoint.read(path).state
    content = bytearray(path.read_bytes())
    entry = content.find(b"PK\x01\x02")
    while entry >= 0:
        content[entry + 38] |= 0x10
        entry = content.find(b"PK\x01\x02", entry + 4)
    path.write_bytes(content)
    found = checkpoint.read(path).state
    assert same(found, sound)


def test_what_is_not_the_model_is_named(tmp_path):
    """A folder was called no checkpoint at all."""
    np.savez(tmp_path / "data.npz", rx_position=np.zeros(3))
    refused("an archive, but not a gsparc checkpoint", checkpoint.read, tmp_path / "data.npz")
    refused("a folder; give the file itself", checkpoint.read, tmp_path)
    (tmp_path / "model.ckpt").touch()
    refused(r"a folder; say .*model\.ckpt", checkpoint.read, tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", ["state", "site"])
def test_numbers_that_are_not_finite_are_refused_by_name(path, part, value):
    """With a right checksum they gave NaN pixels, wrong finite ones, and a confidence of NaN."""
    content = torch.load(path, weights_only=True)
    del content["sha256"]
    tensors = {
        k: v
        for k, v in content[part].items()
        if isinstance(v, torch.Tensor) and v.is_floating_point()
    }
    name, tensor = next(iter(tensors.items()))
    tensor.view(-1)[0] = value
    torch.save(content, path)
    refused(rf"m\.ckpt: {part}\.{name}\[0.*\] is NaN or infinite", checkpoint.read, path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_could_never_be_read_was_written_and_took_the_place_of_what_could(fitted, path, value):
    """A state with NaN was trained, written and praised; only `gsparc.load` refused it."""
    method, before = fitted[0], path.read_bytes()
    sound = method.state()
    name = next(key for key, one in sound.items() if isinstance(one, torch.Tensor))
    method.state = lambda: sound | {name: torch.full((2,), value)}
    refused(rf"m\.ckpt: state\.{name}\[0\] is NaN or infinite", checkpoint.save, path, method)
    with checkpoint.rewriting(path) as file:
        file._content["site"].pop("name")
        refused(r"m\.ckpt: incomplete checkpoint", file.store, {})
    assert path.read_bytes() == before and list(path.parent.glob(".*")) == []


def test_rows_of_who_wrote_meanwhile_were_lost(path):
    """Read, change and write of one were within those of another."""

    def add(name):
        for turn in range(5):
            with checkpoint.rewriting(path) as file:
                told = file.stored.extra.get("told", [])
                time.sleep(0.01)
                file.store({"told": [*told, (name, turn)]})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, range(4)))
    told = checkpoint.read(path).extra["told"]
    assert sorted(told) == [(name, turn) for name in range(4) for turn in range(5)]


def test_a_writer_that_stays_is_said(path, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "WAIT_S", 0.0)
    link = tmp_path / "link.ckpt"
    link.symlink_to(path)
    with ThreadPoolExecutor(1) as pool, checkpoint.rewriting(path):
        busy = r"link\.ckpt: others have been writing it for 0 s; try again, or write another file"
        with pytest.raises(CheckpointError, match=busy):
            pool.submit(lambda: checkpoint.rewriting(link, wait_s=0).__enter__()).result()
        with pytest.raises(CheckpointError, match="others have been writing it"):
            pool.submit(checkpoint.save, path, loading.load(path)[0]).result()
        pool.submit(
            lambda: checkpoint.rewriting(path, tmp_path / "other.ckpt").__enter__()
        ).result()
    checkpoint.update_extra(link, {"note": 1})
    assert link.is_symlink() and checkpoint.read(path).extra["note"] == 1


def leaves(part, at=()):
    """Yield the place of every number, text and tensor in containers."""
    if isinstance(part, (dict, list, tuple)):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            yield from leaves(value, (*at, key))
    elif part is not None:
        yield at


def replaced(part, at, change):
    """The same containers with what stands at a place changed."""
    if not at:
        return change(part)
    if isinstance(part, dict):
        return {key: replaced(v, at[1:], change) if key == at[0] else v for key, v in part.items()}
    return type(part)(replaced(v, at[1:], change) if i == at[0] else v for i, v in enumerate(part))


def mutated(value):
    if isinstance(value, torch.Tensor):
        again = value.clone()
        if again.numel() == 0:
            return torch.ones(1)
        again.view(-1)[-1:] = (
            ~again.view(-1)[-1:] if again.dtype == torch.bool else again.view(-1)[-1:] + 1
        )
        return again
    return (
        not value
        if isinstance(value, bool)
        else value + "x"
        if isinstance(value, str)
        else value + 1
    )


def test_a_changed_content_answered_other_numbers(path, tmp_path):
    """An archive's sums are right of whatever was put in: of 1,357 mutants 100 answered."""
    content, refused = torch.load(path, weights_only=True), 0
    for at in leaves(
        {name: content[name] for name in ("config", "method", "target", "site", "state", "extra")}
    ):
        torch.save(replaced(content, at, mutated), tmp_path / "mutant.ckpt")
        with pytest.raises(CheckpointError, match=r"mutant\.ckpt: ") as caught:
            loading.load(tmp_path / "mutant.ckpt")
        refused += "damaged, or changed" in str(caught.value)
    assert refused > 20
    checkpoint.update_extra(path, {"note": 1})  # our own changes are none
    assert loading.load(path)[1].extra["note"] == 1


def test_a_flipped_bit_in_a_name_left_the_sum_and_the_dataset_unasked(path):
    """A file without a sum passed for an older one; its site lost its hash,
    as both share the name.
    """
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part.replace(b"sha256", b"cha256"))
    refused(r"m\.ckpt: damaged, or changed", checkpoint.read, path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["quantized", "meta", "nested", "an empty sum"])
def test_tensors_of_other_kinds_and_an_empty_sum_were_tracebacks_or_loaded(path, kind):
    content = torch.load(path, weights_only=True)
    if kind == "an empty sum":
        content |= {"sha256": "", "config": "seed: 5"}
    else:
        content["extra"]["x"] = {
            "quantized": lambda: torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.quint8),
            "meta": lambda: torch.empty(3, device="meta"),
            "nested": lambda: torch.nested.nested_tensor([torch.ones(2), torch.ones(3)]),
        }[kind]()
    torch.save(content, path)
    refused(r"m\.ckpt: damaged", checkpoint.read, path)


def test_a_configuration_of_before_names_classes_where_they_are_now(fitted, tmp_path):
    """Datasets had their classes in `gsparc.data.datasets`: older checkpoints name them so."""
    older = "dataset:\n  _target_: gsparc.data.datasets.own.Own\n"
    checkpoint.save(tmp_path / "old.ckpt", fitted[0], older)
    target = checkpoint.read(tmp_path / "old.ckpt").configuration["dataset"]["_target_"]
    assert import_target(target) is Own
