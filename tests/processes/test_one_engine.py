"""Covariances are factored and solved in gsparc/processes alone;
each operation has one definition there.
"""

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
FACTORING = {
    "cholesky",
    "cholesky_ex",
    "cho_factor",
    "potrf",
    "dpotrf",
    "zpotrf",
    "cho_solve",
    "cholesky_solve",
    "cholesky_inverse",
    "solve_triangular",
    "trsm",
    "trtri",
    "dtrtri",
    "trtrs",
    "potri",
    "dpotri",
    "potrs",
}
DEFINED = ("left_out_around", "fit_by_ep")


def called(node: ast.Call) -> str:
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def test_each_operation_is_in_its_place_alone():
    where: dict[str, set[str]] = defaultdict(set)
    words = re.compile(rf"\b(?:{'|'.join([*FACTORING, *DEFINED])})\b")
    for path in sorted((ROOT / "gsparc").rglob("*.py")):
        text, name = path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(text)) if words.search(text) else ():
            if isinstance(node, ast.FunctionDef) and node.name in DEFINED:
                where[node.name].add(name)
            elif isinstance(node, ast.Call) and called(node) in FACTORING:
                where["factor"].add(name)
    assert where["factor"] == {"gsparc/processes/factor.py"}
    assert where["left_out_around"] == {"gsparc/processes/left_out.py"}
    assert where["fit_by_ep"] == {"gsparc/processes/censored.py"}
