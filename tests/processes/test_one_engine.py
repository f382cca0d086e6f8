"""Covariances are factored and solved in gsparc/processes alone; each operation has one definition there."""

import ast
from collections import defaultdict
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
    "gsparc/prediction/channels.py": "a baseline's filter over tones, no covariance of places",
    "gsparc/apps/export/along/taps.py": "taps of a delay line by least squares, no covariance of places",
    "gsparc/apps/link/pusch.py": "the receiver's filter of a link, no covariance of places",
    "gsparc/data/datasets/powder.py": "a map from degrees to metres by least squares",
    "gsparc/data/checks/level_steps.py": "a mean law by least squares",
    "gsparc/data/checks/conventions.py": "the lobe about a strongest direction by least squares",
    "gsparc/physics/lags.py": "a basis of an array's lags",
    "gsparc/models/refined_places.py": "three coordinates of a place's error",
    "gsparc/models/directional/position_refine.py": "three coordinates of a source",
    "gsparc/models/directional/triangulation.py": "three coordinates of a source",
    "gsparc/models/uplink/search.py": "a batch of source fits in single precision, at times singular",
    "gsparc/models/uplink/error_model.py": "six terms of a regression",
    "gsparc/models/moving_array/triangulate.py": "powers of sources by least squares",
    "gsparc/models/splat/reduce.py": "weights of fewer Gaussians by least squares",
}


def test_each_operation_is_in_its_place_alone():
    """Also residuals over a precision, sweeps of expectation propagation, and systems of nearest rows."""
    where: dict[str, set[str]] = defaultdict(set)
    defined: dict[str, list[str]] = defaultdict(list)
    for path in sorted((ROOT / "gsparc").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name in ("left_out_group", "propagate"):
                defined[node.name].append(name)
            elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                right = ast.unparse(node.right).split("[")[0]
                if right in ("precision", "self.factor.precision", "inverse.diagonal()"):
                    where["residuals over a precision"].add(name)
            elif isinstance(node, ast.Call):
                of, _, called = ast.unparse(node.func).rpartition(".")
                if called in FACTORING | SOLVING:
                    where["factor"].add(name)
                elif called in GENERAL and of.endswith("linalg"):
                    where["general"].add(name)
                elif called == "log_ndtr":
                    where["expectation propagation"].add(name)
                elif (of, called) == ("", "solved") and "gram" in ast.unparse(node):
                    where["systems of nearest rows"].add(name)
    assert where["factor"] == {FACTOR}
    there = {name for name in EXCEPTIONS if (ROOT / name).is_file()}  # the core may stand alone
    assert where["general"] == there, where["general"] ^ there
    # The probability of a silent row alone, nothing is propagated.
    silence = {f"gsparc/{name}.py" for name in ("apps/locate/likelihood", "data/links/strongest")}
    silence = {name for name in silence if (ROOT / name).is_file()}
    silence.add("gsparc/models/powers/together/network.py")
    assert where["expectation propagation"] == {"gsparc/processes/censored.py"} | silence
    assert defined["left_out_group"] == ["gsparc/processes/left_out.py"]
    assert defined["propagate"] == ["gsparc/processes/censored.py"]
    kept = {"gsparc/processes/left_out.py", "gsparc/processes/censored.py"}  # the cavity is one row left out
    assert where["residuals over a precision"] <= kept
    assert where["systems of nearest rows"]
