"""Covariances are factored and solved in gsparc/processes alone; each operation has one definition there."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FACTOR = "gsparc/processes/factor.py"
FACTORING = {"cholesky", "cholesky_ex", "cho_factor", "potrf", "dpotrf", "zpotrf"}
SOLVING = {
    "cho_solve", "cholesky_solve", "cholesky_inverse", "solve_triangular", "trsm", "trtri", "dtrtri", "trtrs",
    "potri", "dpotri", "potrs",
}  # fmt: skip
GENERAL = {"solve", "inv", "lstsq", "lu_factor", "lu_solve"}  # of numpy.linalg, torch.linalg and scipy.linalg
EXCEPTIONS = {  # who solves a system for itself, and why
    "gsparc/models/baselines/kriging.py": "an independent check of the engine",
    "gsparc/models/baselines/ridge.py": "a baseline: complex ridge regression, no covariance of places",
    "gsparc/prediction/export.py": "a baseline's filter over tones, no covariance of places",
    "gsparc/prediction/along/taps.py": "taps of a delay line by least squares, no covariance of places",
    "gsparc/evaluation/link/pusch.py": "the receiver's filter of a link, no covariance of places",
    "gsparc/data/datasets/powder.py": "a map from degrees to metres by least squares",
    "gsparc/data/checks/level_steps.py": "a mean law by least squares",
    "gsparc/physics/lags.py": "a basis of an array's lags",
    "gsparc/models/refined_places.py": "three coordinates of a place's error",
    "gsparc/models/directional/position_refine.py": "three coordinates of a source",
    "gsparc/models/directional/triangulation.py": "three coordinates of a source",
    "gsparc/models/uplink/search.py": "a batch of source fits in single precision, at times singular",
    "gsparc/models/uplink/error_model.py": "six terms of a regression",
    "gsparc/models/moving_array/triangulate.py": "powers of sources by least squares",
    "gsparc/models/splat/reduce.py": "weights of fewer Gaussians by least squares",
}


def calls(path: Path) -> Iterator[tuple[str, str]]:
    """Every called name with what stands before its dot."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield node.func.attr, ast.unparse(node.func.value)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id, ""


def test_nobody_else_factors_or_solves():
    where: dict[str, set[str]] = defaultdict(set)
    for path in sorted((ROOT / "gsparc").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        for called, of in calls(path):
            if called in FACTORING | SOLVING:
                where["factor"].add(name)
            elif called in GENERAL and of.endswith("linalg"):
                where["general"].add(name)
            elif called == "log_ndtr":
                where["expectation propagation"].add(name)
    assert where["factor"] == {FACTOR}
    assert where["general"] == set(EXCEPTIONS), where["general"] ^ set(EXCEPTIONS)
    silence = {"gsparc/locate/likelihood.py"}  # the probability of a silent row alone, nothing is propagated
    assert where["expectation propagation"] == {"gsparc/processes/censored.py"} | silence


def test_each_operation_has_one_definition():
    """Of residuals over a precision, sweeps of expectation propagation, and systems of nearest rows."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in sorted((ROOT / "gsparc").rglob("*.py")):
        name, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.name in ("left_out_group", "propagate"):
                found[node.name].append(name)
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                right = ast.unparse(node.right)
                if right.split("[")[0] in ("precision", "self.factor.precision", "inverse.diagonal()"):
                    found["residuals over a precision"].append(name)
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func) == "solved"
                and "gram" in ast.unparse(node)
            ):
                found["systems of nearest rows"].append(name)
    assert found["left_out_group"] == ["gsparc/processes/left_out.py"]
    assert found["propagate"] == ["gsparc/processes/censored.py"]
    kept = {"gsparc/processes/left_out.py", "gsparc/processes/censored.py"}  # the cavity is one row left out
    assert set(found["residuals over a precision"]) <= kept
    assert found["systems of nearest rows"]
