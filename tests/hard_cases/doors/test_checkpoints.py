"""Hostile and damaged checkpoints at the doors that read them: nothing executes, one line says why.

Remedy: gsparc/models/checkpoint.py (weights-only unpickling, only classes of gsparc are built).
Each hostile file would leave a mark; no mark may appear. Naive: `pickle.load` and
`torch.load(weights_only=False)` leave it.
"""

import builtins
import os
import pickle
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import spectra
from contexts import loaded
from doors import assert_refused, knock

import gsparc
from gsparc.commands.listing import COMMANDS
from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.models.registry import build
from gsparc.training.context import FitContext

evaluate = COMMANDS["evaluate"].run

MARK = "owned"


class Calls:
    """Pickles to a call."""

    def __init__(self, function: Callable, *arguments: object) -> None:
        self.parts = function, arguments

    def __reduce__(self):
        return self.parts


def payloads(mark: Path) -> dict[str, object]:
    """Objects whose unpickling by an ordinary unpickler touches `mark`."""
    code = f"open({str(mark)!r}, 'w')"
    return {
        "os.system": Calls(os.system, f"touch {mark}"),
        "eval": Calls(eval, code),
        "exec": Calls(exec, code),
        "open": Calls(builtins.open, str(mark), "w"),
        "subprocess": Calls(subprocess.call, ["touch", str(mark)]),
        "Path.touch": Calls(Path.touch, mark),
        "torch.save": Calls(torch.save, {}, str(mark)),
        "numpy.save": Calls(np.save, str(mark), np.ones(1)),
        "getattr": Calls(getattr, Calls(__import__, "os"), "system"),
        "a class of ours": checkpoint.StoredModel("m", "t", "", None, {}),
    }


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> tuple[Path, Path]:
    """A checkpoint of IDW, and its data."""
    folder = tmp_path_factory.mktemp("sound")
    file = spectra(folder / "own.npz")
    config = "model: {_target_: gsparc.models.baselines.idw.InverseDistance}\n"
    method = build({"_target_": "gsparc.models.baselines.idw.InverseDistance"})
    method.fit(*loaded(file), FitContext(folder))
    checkpoint.save(folder / "m.ckpt", method, config)
    return folder / "m.ckpt", file


def altered(sound: Path, to: Path, **changes: object) -> Path:
    content = torch.load(sound, weights_only=True)
    del content["sha256"]  # as of an older file: other guards are asked
    content.update(changes)
    torch.save(content, to)
    return to


def assert_refused_here(path: Path, says: str) -> None:
    """By `gsparc.load`, in a line that names the file."""
    with pytest.raises(CheckpointError, match=says) as refused:
        gsparc.load(path)
    assert "\n" not in str(refused.value) and path.name in str(refused.value)


def assert_refused_everywhere(path: Path, file: Path, run: Path, says: str) -> None:
    """By `gsparc.load` and `gsparc evaluate`."""
    assert_refused_here(path, says)
    given = [f"ckpt={path}", "dataset.name=own", f"dataset.file={file}", f"hydra.run.dir={run}"]
    assert_refused(knock(evaluate, "evaluate", given), says, run)


@pytest.mark.parametrize("place", ["state", "extra", "whole"])
@pytest.mark.parametrize("name", payloads(Path()))
def test_nothing_executes(sound, tmp_path, name, place):
    thing = payloads(tmp_path / MARK)[name]
    path = tmp_path / "hostile.ckpt"
    if place == "whole":
        torch.save(thing, path)
    else:
        altered(sound[0], path, **{place: {"x": thing}})
    with pytest.raises(CheckpointError, match=r"hostile\.ckpt: .*(could run code|cannot be read)"):
        gsparc.load(path)
    assert not (tmp_path / MARK).exists()


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.exec",
        3,
        "pathlib.Path.touch",
        "gsparc.models.checkpoint.os.system",
        "gsparc.datasets.load.log",
        "torch.load",
        "gsparc.models.registry.build",
        "gsparc.nowhere.Nothing",
        "gsparc",
        "",
        "hydra.utils.call",
    ],
)
def test_configurations_that_ask_to_run_something(sound, tmp_path, target):
    mark = tmp_path / MARK
    config = f"model: {{_target_: '{target}', _args_: ['{mark}']}}\n"
    for name, changes in {
        "named": {"config": config, "target": target},
        "nested": {
            "config": "model: {_target_: gsparc.models.baselines.idw.InverseDistance, "
            f"power: {config[7:-1]}}}\n",
            "target": "gsparc.models.baselines.idw.InverseDistance",
        },
        "listed": {
            "config": "model: {_target_: gsparc.models.baselines.idw.InverseDistance, "
            f"power: [{config[7:-1]}]}}\n",
            "target": "gsparc.models.baselines.idw.InverseDistance",
        },
    }.items():
        assert_refused_here(altered(sound[0], tmp_path / f"{name}.ckpt", **changes), "")
    assert not mark.exists()


def aliased() -> str:
    """Nine levels of nine aliases, 300 bytes, had no end in 200 s."""
    levels = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else 'x'] * 9)}]\n" for i in range(9)]
    return "".join(levels) + "model: {_target_: gsparc.models.baselines.idw.InverseDistance}\n"


def nested(width: int, depth: int) -> list:
    """The same list many times, or lists in lists."""
    found = ["x"]
    for _ in range(depth):
        found = [found] * width
    return found


@pytest.mark.parametrize(
    "changes,says",
    [
        *(
            ({"version": one}, f"of version {one}, this gsparc reads 2; train again")
            for one in (99, "2", 1, None)
        ),
        ({"format": "other"}, "not a gsparc checkpoint"),
        ({"site": {}}, "incomplete"),
        ({"site": None}, "incomplete"),
        ({"state": [1, 2]}, "incomplete"),
        ({"state": {}}, "cannot be restored"),
        (
            {"target": "gsparc.models.baselines.gp.GaussianProcess", "config": ""},
            "cannot be restored",
        ),
        ({"config": "model: ["}, "not YAML"),
        ({"config": "a: !!python/object/apply:os.system ['true']"}, "not YAML"),
        ({"config": aliased()}, "aliases"),
        *(
            ({"state": {"x": part}}, "many times")
            for part in (nested(9, 9), nested(1, 100), torch.zeros(1).expand(1 << 40))
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_content_that_does_not_fit(sound, tmp_path, changes, says):
    assert_refused_here(altered(sound[0], tmp_path / "odd.ckpt", **changes), says)


def test_an_ordinary_unpickler_would_run_them(tmp_path):
    """Naive: what every payload does to `pickle.load`;
    without it nothing above would show anything.
    """
    for name, thing in payloads(tmp_path / MARK).items():
        if name in ("a class of ours", "getattr"):
            continue
        pickle.loads(pickle.dumps(thing))
        mark = [path for path in tmp_path.iterdir() if path.name.startswith(MARK)]
        assert mark, name
        mark[0].unlink()


def test_a_deflated_entry_is_not_inflated(sound, tmp_path):
    """3 MB held one entry of 3 GB: 65 s and 6.4 GB, and it loaded."""
    bomb = tmp_path / "bomb.ckpt"
    with (
        zipfile.ZipFile(sound[0]) as archive,
        zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as copy,
    ):
        for name in archive.namelist():
            copy.writestr(name, archive.read(name))
        copy.writestr("archive/more", bytes(1 << 24))
    assert bomb.stat().st_size < 1 << 20
    assert_refused_everywhere(
        bomb, sound[1], tmp_path / "run", "compressed, or larger than the file"
    )
