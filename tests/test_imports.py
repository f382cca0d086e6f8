"""Imports point one way: conf -> callbacks -> gsparc -> ops; nobody prints; ops register once."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from campaigns import brief, spectra

ROOT = Path(__file__).parents[1]
ROOMS = {"ops": ROOT / "ops", "gsparc": ROOT / "gsparc", "callbacks": ROOT / "callbacks"}
MAY_USE = {"ops": {"ops"}, "gsparc": {"ops", "gsparc"}, "callbacks": {"ops", "gsparc", "callbacks"}}
FILES = [(room, file) for room, folder in ROOMS.items() for file in sorted(folder.rglob("*.py"))]


def imported(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(name: str) -> str | None:
    parts = name.split(".")
    if parts[0] != "gsparc":
        return None
    return parts[1] if len(parts) > 1 and parts[1] in ("ops", "callbacks", "conf") else "gsparc"


@pytest.mark.parametrize(("room", "file"), FILES, ids=[f"{r}/{f.name}" for r, f in FILES])
def test_imports_point_one_way(room, file):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for name in imported(tree):
        assert name.split(".")[0] not in ("ops", "callbacks", "conf", "tests"), (
            f"{name}: import gsparc.{name}"
        )
        used = room_of(name)
        if used is None or name == "gsparc":
            continue
        assert used in MAY_USE[room], f"{room} must not know {name}"
    if room == "ops":
        heavy = {"lightning", "hydra", "omegaconf", "gsparc.data"}
        assert not {n.split(".")[0] for n in imported(tree)} & heavy


def test_data_know_nothing_of_models_and_losses():
    """Loaders may ask for a simulation or an encoder, by name; they learn nothing and judge nothing."""
    allowed = {"data", "ops", "atomic", "simulate", "encoder"}
    for file in sorted((ROOT / "gsparc" / "data").glob("*.py")):
        names = [name for name in imported(ast.parse(file.read_text(encoding="utf-8"))) if "." in name]
        used = {name.split(".")[1] for name in names if name.startswith("gsparc.")}
        assert used <= allowed, f"{file.name} knows {used - allowed}"


@pytest.mark.parametrize("file", [file for _, file in FILES] + [ROOT / "train.py"], ids=lambda p: p.name)
def test_nothing_prints_and_nothing_happens_at_import(file):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert not [c.lineno for c in calls if c.func.id == "print"], "print: use logging or rich"
    for node in tree.body:  # os.environ, torch.set_num_threads, ... belong into functions
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            called = ast.unparse(node.value.func)
            # Declaring an operator's derivative is part of declaring the operator.
            declares = ".register_" in called
            # The one exception: how torch's threads wait is settled when torch is first imported.
            waits = file == ROOT / "gsparc" / "__init__.py" and called == "os.environ.setdefault"
            assert declares or waits, f"{file.name}:{node.lineno} calls {called} at import"


@pytest.mark.parametrize(("said", "found"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_torch_threads_do_not_spin_beside_the_kernels(said, found):
    """At 62,000 Gaussians on two cores spinning doubled a query; who wants it can say so."""
    code = "import os, gsparc, torch; print(os.environ['OMP_WAIT_POLICY'])"
    clean = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], env=clean | said, capture_output=True, text=True)
    assert done.stdout.strip() == found, done.stderr


def test_the_bare_names_refuse_to_be_imported():
    """From the repository root `ops` can be found too; registered twice, torch would crash."""
    done = subprocess.run(
        [sys.executable, "-c", "import gsparc.ops, ops"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 1 and "import that instead of 'ops'" in done.stderr


def test_importing_the_package_is_free():
    code = "import sys, gsparc; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


@pytest.mark.slow
def test_a_wheel_installed_elsewhere_trains(tmp_path):
    """Built, installed without the source tree in sight, run as a user would."""
    file = spectra(tmp_path / "own.npz")
    wheels, home = tmp_path / "wheels", tmp_path / "home"
    home.mkdir()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(wheels), str(ROOT)]
    made = subprocess.run(
        [*build, f"-Cbuild-dir={tmp_path / 'build'}"], capture_output=True, text=True, cwd=tmp_path
    )
    if made.returncode and "scikit_build_core" in made.stderr:
        pytest.skip("the build requirements of the wheel are not installed here")
    assert made.returncode == 0, made.stderr
    (wheel,) = wheels.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = str(tmp_path / "venv" / "bin" / "python")
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True)
    # A path in a .pth file brings this environment's packages without its .pth files (an editable gsparc).
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    where = "import gsparc, gsparc.ops, gsparc.conf; print(gsparc.__file__, *gsparc.conf.__path__)"
    found = subprocess.run(
        [python, "-c", where], cwd=home, env=environment, capture_output=True, text=True, check=True
    )
    assert all(part.startswith(str(site)) for part in found.stdout.split()), found.stdout
    run = [python, "-m", "gsparc", "train", *brief(file), f"hydra.run.dir={home / 'run'}"]
    done = subprocess.run(run, cwd=home, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (home / "run" / "summary.json").exists()
