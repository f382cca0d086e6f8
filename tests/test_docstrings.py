"""Examples of docstrings answer what they say."""

import ast
import doctest
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

import gsparc

RNG = np.random.default_rng(0)
PLACES = np.c_[RNG.uniform(0, 9, (60, 2)), np.full(60, 1.5)]
ENDS = np.array([[4.0, 4.0, 2.6], [9.0, 9.0, 2.6]])
POWERS = (
    -30 - 25 * np.log10(np.linalg.norm(PLACES[:, None] - ENDS, axis=2)) + RNG.normal(size=(60, 2))
)
ROOT = Path(__file__).parents[1]
DESCRIBED = ast.Module, ast.ClassDef, ast.FunctionDef
# Of Python, and of a user's table
OTHERS = {"yield", "tx_x_mm"}
PACKAGES = {"gsparc": "gsparc", "ops": "gsparc.ops", "callbacks": "gsparc.callbacks"}  # by folder
# They ask for Sionna's solver, or for a cloud of a trained field.
ELSEWHERE = ("gsparc.apps.view.ply",)


def with_examples() -> dict[str, int]:
    """Lines of examples in the source of each module that has any."""
    counts = {}
    for folder, package in PACKAGES.items():
        for file in sorted((ROOT / folder).rglob("*.py")):
            name = ".".join([package, *file.relative_to(ROOT / folder).with_suffix("").parts])
            counts[name.removesuffix(".__init__")] = len(
                re.findall(r"^\s*>>> ", file.read_text(), re.M)
            )
    return {name: count for name, count in counts.items() if count and name not in ELSEWHERE}


EXAMPLES = with_examples()


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder with the files that the examples load."""
    folder = tmp_path_factory.mktemp("examples")
    gsparc.fit(rx=PLACES, tx=ENDS[0], rssi=POWERS[:, 0], model="gp", save=folder / "model.ckpt")
    degrees = {
        "latitude": 40.765 + PLACES[:, 1] * 1e-5,
        "longitude": -111.835 + PLACES[:, 0] * 1e-5,
    }
    ends = {
        "station_latitude": 40.765 + ENDS[:, 1] * 1e-5,
        "station_longitude": -111.835 + ENDS[:, 0] * 1e-5,
    }
    names = {"station_name": np.array(["roof-2", "roof-3"])}
    gsparc.fit(**degrees, **ends, **names, rssi=POWERS, model="gp", save=folder / "city.ckpt")
    return folder


def words_of_code(tree: ast.AST) -> set[str]:
    """Names, attributes, modules and texts of a file, but for its docstrings."""
    described = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, DESCRIBED) and ast.get_docstring(node) is not None
    }
    words = []
    for node in ast.walk(tree):
        words += [
            getattr(node, part, None) or ""
            for part in ("name", "arg", "id", "attr", "module", "asname")
        ]
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in described
        ):
            words.append(node.value)
    return set(re.findall(r"[A-Za-z_]\w*", " ".join(words)))


@pytest.mark.slow
def test_docstrings_named_functions_that_are_gone():
    """`fit_factors`, `Behind` and `rows_of` were looked for in vain."""
    files = [file for folder in PACKAGES for file in sorted((ROOT / folder).rglob("*.py"))]
    trees = {file: ast.parse(file.read_text()) for file in files}
    known = {file.stem for file in files}.union(*map(words_of_code, trees.values()))
    for kind in (
        "conf/**/*.yaml",
        "gsparc/**/*.yaml",
        "gsparc/**/*.csv",
        "ops/**/*.h",
        "docs/**/*.md",
    ):
        known.update(*(re.findall(r"[A-Za-z_]\w*", file.read_text()) for file in ROOT.glob(kind)))
    gone = []
    for file, tree in trees.items():
        for node in (one for one in ast.walk(tree) if isinstance(one, DESCRIBED)):
            said = re.findall(
                r"`((?:[A-Za-z_]+\.)*[A-Za-z_]+)(?:\(\))?`", ast.get_docstring(node) or ""
            )
            ours = {name for name in said if not name.startswith("sionna.")} - OTHERS
            gone += [
                f"{file.name}: {name}" for name in ours if not known.issuperset(name.split("."))
            ]
    assert not gone


@pytest.fixture(scope="module")
def predictor(checkpoints):
    return gsparc.load(checkpoints / "model.ckpt")


def test_docstrings_named_arguments_that_are_gone():
    """Three functions described `more`, `promise` and `missing`, which had other names by then."""
    gone = []
    for file in sorted(file for folder in PACKAGES for file in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.FunctionDef):
                continue
            text = ast.get_docstring(node) or ""
            section = re.search(r"^Args:\n((?:    .*\n?|\n)+)", text, re.M)
            said = re.findall(r"^    ([*\w][*\w, ]*): ", section[1], re.M) if section else []
            known = {one.arg for one in ast.walk(node.args) if isinstance(one, ast.arg)}
            names = {name.lstrip("*") for names in said for name in names.split(", ")}
            gone += [f"{file.name}: {node.name}({name})" for name in sorted(names - known)]
    assert not gone


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_docstrings_run(name, checkpoints, predictor, monkeypatch):
    monkeypatch.chdir(checkpoints)
    module = import_module(name)
    known = {"gsparc": gsparc, "torch": torch, "np": np, "predictor": predictor}
    known |= {"places": PLACES, "powers_dbm": POWERS[:, 0], **vars(module)}
    runner, report = doctest.DocTestRunner(), list[str]()
    for test in doctest.DocTestFinder(exclude_empty=True).find(module, name, globs={}):
        test.globs = dict(known)
        runner.run(test, out=report.append)
    assert not runner.failures, "".join(report)
    assert runner.tries == EXAMPLES[name], "an example stands where none is looked for"


@pytest.mark.parametrize("name", gsparc.__all__)
def test_whatever_is_public_has_an_example(name):
    assert ">>> " in getattr(gsparc, name).__doc__
