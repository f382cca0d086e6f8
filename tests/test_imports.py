"""Rooms import what a list allows, and no circle; ops register once. That nobody prints:
ruff (T20).
"""

import ast
import importlib
import importlib.util
import os
import re
import subprocess
import sys
import sysconfig
from collections import defaultdict
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# What each room may import; a new arrow is added here, where it can be seen, or it is not made.
ARROWS = {
    "base": "",
    "ops": "",
    "processes": "base ops",
    "physics": "ops",
    "data": "base ops physics processes",
    "tables": "base data ops physics processes",
    "datasets": "base conf data ops physics tables",
    "simulate": "base data datasets ops physics processes tables",
    "training": "base data datasets processes",
    "field": "base data datasets ops physics processes training",
    "models": "base conf data datasets field ops physics processes simulate tables training",
    "prediction": "base data datasets field models ops physics processes tables training",
    "evaluation": "base conf data models physics prediction processes tables training",
    "runs": "base data datasets evaluation models physics prediction simulate tables training",
    "pictures": "base data datasets evaluation field models physics prediction processes runs "
    "simulate tables training",
    "callbacks": "base evaluation field pictures processes training",
    "apps.locate": "base data datasets evaluation models pictures prediction processes runs",
    "apps.maps": "base data datasets evaluation models physics pictures prediction processes runs "
    "tables",
    "apps.export": "base data field models ops physics prediction processes tables",
    "apps.link": "base data datasets models physics pictures prediction processes runs simulate",
    "apps.view": "apps.maps base data physics pictures prediction processes runs",
    "commands": "apps.export apps.link apps.locate apps.maps apps.view base conf data datasets "
    "evaluation models ops pictures prediction runs simulate tables training",
    "conf": "",
}
ROOMS = tuple(ARROWS)
LARGEST = ("models", "tables", "commands")
# Of entry points: what plugins bring, by these very words
GROUPS = ("gsparc.models", "gsparc.datasets")


def inside(room: str) -> str:
    return f"gsparc/{room.replace('.', '/')}"


FILES = [
    (room, file)
    for room in ROOMS
    for file in sorted((ROOT / (room if (ROOT / room).is_dir() else inside(room))).rglob("*.py"))
]


def imported(tree: ast.Module):
    """Modules and names, also those within functions; of expressions, nine tenths,
    nothing is asked.
    """
    todo: list[ast.AST] = [tree]
    for node in todo:
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, part, None)
            todo += inner if isinstance(inner, list) else []
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def named(text: str):
    """Modules and classes in strings: of `import_module`, `_target_`,
    registries and tables of lazy names.
    """
    found = re.findall(r"""["'](?:pkg://)?(gsparc(?:\.\w+)+)["']""", text)
    yield from (name for name in found if name not in GROUPS)


def needed(file: Path):
    """What is imported or named, but for types alone."""
    body = [node for node in _tree(file).body if not _of_types(node)]
    yield from imported(ast.Module(body, []))
    yield from named(_text(file))


def _of_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def room_of(name: str) -> str | None:
    parts = name.split(".")
    room = ".".join(parts[1 : 3 if parts[1:2] == ["apps"] else 2])
    return room if parts[0] == "gsparc" and room in ROOMS else None


@cache
def arrows() -> dict[tuple[str, str], set[str]]:
    """Which room imports which, and the files that do."""
    found = defaultdict(set)
    for room, file in FILES:
        for name in _needs(file):
            used = room_of(name)
            if used not in (None, room):
                found[room, used].add(file.relative_to(ROOT).as_posix())
    return found


@pytest.mark.slow
def test_rooms_import_what_the_list_allows_and_nothing_else():
    found = arrows()
    allowed = {(room, other) for room, others in ARROWS.items() for other in others.split()}
    new = {pair: files for pair, files in found.items() if pair not in allowed}
    assert not new, f"arrows that are not on the list: {new}"
    assert not allowed - set(found), f"on the list, and nobody needs them: {allowed - set(found)}"
    # No circle
    TopologicalSorter({room: others.split() for room, others in ARROWS.items()}).prepare()


def test_the_map_left_out_imports_that_the_list_allows():
    """`gsparc/models` was said to do without `field`."""
    lines = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| `")]
    uses = {row[0].strip("`/").removeprefix("gsparc/").replace("/", "."): row[-1] for row in rows}
    assert not {*ROOMS} - {*uses}
    said = {
        room: re.sub(r" \([^)]*\)", "", uses[room]).replace("/", ".").split(", ") for room in ROOMS
    }
    assert {room: {*names} & {*ROOMS} for room, names in said.items()} == {
        room: {*others.split()} for room, others in ARROWS.items()
    }


@pytest.mark.parametrize("room", LARGEST)
def test_no_file_needs_itself(room):
    """`graphlib.CycleError` names the circle."""
    files = {module_of(file): file for one, file in FILES if one == room}
    used = {}
    for module, file in files.items():
        found = {_of(name, files) for name in needed(file)}
        used[module] = found - {module, None}
    assert len(list(TopologicalSorter(used).static_order())) >= len(
        [one for one in used if used[one]]
    )


def module_of(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def _of(name: str, files: dict[str, Path]) -> str | None:
    """The file of a module, or of what is in one."""
    while name and name not in files:
        name = name.rpartition(".")[0]
    return name or None


def test_the_core_does_without_the_apps():
    """What is done with predictions is known to the commands alone,
    also in functions and strings.
    """
    above = [ROOT / "gsparc" / name for name in ("apps", "commands")]
    rooms = [ROOT / name for name in ("gsparc", "ops", "callbacks", "bench", "hydra_plugins")]
    core = [file for room in rooms for file in room.rglob("*.py") if not {*above} & {*file.parents}]
    assert len(core) > 300
    wrong = {file for file in core for name in _needs(file) if _is_app(name)}
    wrong |= {
        file for file in (ROOT / "conf").rglob("*.yaml") if "gsparc.apps" in file.read_text("utf-8")
    }
    assert not wrong


def _is_app(name: str) -> bool:
    return (name + ".").startswith("gsparc.apps.")


def test_importing_the_operators_builds_and_loads_no_cuda():
    """What is imported at the top of files, from that of the package on."""
    files, met = {module_of(file): file for room, file in FILES if room == "ops"}, ["ops"]
    for module in met:
        names = [name.removeprefix("gsparc.") for name in imported(_top(_tree(files[module])))]
        met += [name for name in dict.fromkeys(names) if name in files and name not in met]
    assert len(met) > 9 and not [name for name in met if name.startswith("ops.cuda")]


def test_only_the_viewers_server_imports_viser():
    used = [file for _, file in FILES if "viser" in {n.split(".")[0] for n in _imports(file)}]
    assert used and {file.parent for file in used} == {ROOT / "gsparc" / "apps" / "view" / "server"}
    kept = ROOT / "gsparc" / "apps" / "view" / "server"
    above = {
        file.relative_to(ROOT).as_posix()
        for _, file in FILES
        if file.parent != kept
        and any(n.startswith("gsparc.apps.view.server") for n in imported(_top(_tree(file))))
    }
    assert not above, "imported where it is needed, in a function: the command does without viser"


@cache
def _imports(file: Path) -> tuple[str, ...]:
    return tuple(imported(_tree(file)))


@cache
def _needs(file: Path) -> frozenset[str]:
    return frozenset((*_imports(file), *named(_text(file))))


@cache
def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8")


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(_text(file))


def _top(tree: ast.Module) -> ast.Module:
    """What runs at import."""
    kept = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    return ast.Module(kept, [])


def test_imports_have_full_names():
    for room, file in FILES:
        names = set(_imports(file))
        bare = {
            name for name in names if name.split(".")[0] in ("ops", "callbacks", "conf", "tests")
        }
        assert not bare, f"{file}: {bare}: import gsparc.NAME"
        if room == "ops":
            assert not {name.split(".")[0] for name in names} & {
                "lightning",
                "hydra",
                "omegaconf",
            }, file


def test_nothing_happens_at_import():
    for file in (*(file for _, file in FILES), ROOT / "train.py"):
        tree = _tree(file)
        for node in tree.body:  # os.environ, torch.set_num_threads, ... belong into functions
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
                called = ast.unparse(node.value.func)
                # Declaring an operator's derivative is part of declaring the operator.
                declares = ".register_" in called
                # The one exception: how torch's threads wait is settled when torch is first
                # imported.
                waits = (
                    file == ROOT / "gsparc" / "__init__.py" and called == "os.environ.setdefault"
                )
                assert declares or waits, f"{file}:{node.lineno} calls {called} at import"


@pytest.mark.parametrize(
    ("said", "found"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")]
)
def test_importing_the_package_is_free_and_keeps_torch_threads_from_spinning(said, found):
    """At 62,000 Gaussians on two cores spinning doubled a query; who wants it can say so."""
    code = "import os, sys, gsparc; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    clean = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean | said, capture_output=True, text=True
    )
    assert done.stdout.split() == [found, "False"], done.stderr


def test_the_bare_names_refuse_to_be_imported(monkeypatch):
    """From the repository root `ops` can be found too; registered twice, torch would crash."""
    monkeypatch.syspath_prepend(str(ROOT))
    with pytest.raises(ImportError, match="import that instead of 'ops'"):
        importlib.import_module("ops")


@pytest.mark.slow
def test_a_wheel_installed_elsewhere_trains(tmp_path):
    """Built, installed without the source tree, a compiler or data in sight,
    run as a user would.
    """
    pytest.importorskip("auditwheel", reason="auditwheel is not installed")
    wheels, home = tmp_path / "wheels", tmp_path / "home"
    home.mkdir()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    quick = tmp_path / "quick"  # to build: the kernels ask for -O3, the last level counts
    quick.write_text('#!/bin/sh\nexec "$@" -O0\n')
    quick.chmod(0o755)
    given = f"-Ccmake.define.CMAKE_CXX_COMPILER_LAUNCHER={quick} -Ccmake.define.GSPARC_PORTABLE=ON"
    portable = f"-Cbuild-dir={tmp_path / 'build'} -Ccmake.build-type=Debug {given}"
    make = [
        "make",
        "-o",
        "setup",
        "wheel",
        f"VENV={sys.prefix}",
        f"WHEEL={portable}",
        f"DIST={wheels}",
    ]
    made = subprocess.run(make, capture_output=True, text=True, cwd=ROOT)
    assert made.returncode == 0, made.stderr
    (wheel,) = wheels.glob("*.whl")
    assert "manylinux" in wheel.name
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True
    )
    python = str(tmp_path / "venv" / "bin" / "python")
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True)
    # A path in a .pth file brings this environment's packages without its .pth files (an editable
    # gsparc).
    torch = importlib.util.find_spec("torch")
    places = (sysconfig.get_path("purelib"), Path(torch.origin).parents[1])
    (site / "dependencies.pth").write_text("".join(f"{place}\n" for place in places))
    nothing = tmp_path / "nothing"  # on the path: no compiler, no command of this environment
    nothing.mkdir()
    environment = {"HOME": str(home), "PATH": str(nothing), "OMP_NUM_THREADS": "1"}

    def say(*words: str) -> str:
        done = subprocess.run(
            [python, *words], cwd=home, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    small = ["dataset.count=60", "trainer.max_steps=4", "baselines=[mean]"]
    say("-m", "gsparc", "train", "experiment=demo", *small, f"hydra.run.dir={home / 'run'}")
    assert (home / "run" / "summary.json").exists()
    code = """
import gsparc, gsparc.ops, gsparc.conf
assert gsparc.__version__[0].isdigit()
print(gsparc.__file__, gsparc.ops.__file__, *gsparc.conf.__path__)
print(*gsparc.load("run/model.ckpt").spectrum(tx=[[0, -0.1, 0.1 * i] for i in range(5)]).shape)"""
    where, shape = say("-c", code).splitlines()
    assert all(part.startswith(str(site)) for part in where.split()), where
    assert shape == "5 90 360"
