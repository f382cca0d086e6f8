"""Covariances are factored and solved in gsparc/processes alone; each operation has one definition there."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
FACTORING = {
    "cholesky", "cholesky_ex", "cho_factor", "potrf", "dpotrf", "zpotrf", "cho_solve", "cholesky_solve",
    "cholesky_inverse", "solve_triangular", "trsm", "trtri", "dtrtri", "trtrs", "potri", "dpotri", "potrs",
}  # fmt: skip


def test_each_operation_is_in_its_place_alone():
    where: dict[str, set[str]] = defaultdict(set)
    for path in sorted((ROOT / "gsparc").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name in ("left_out_group", "propagate"):
                where[node.name].add(name)
            elif isinstance(node, ast.Call):
                called = ast.unparse(node.func).rpartition(".")[2]
                if called in FACTORING:
                    where["factor"].add(name)
    assert where["factor"] == {"gsparc/processes/factor.py"}
    assert where["left_out_group"] == {"gsparc/processes/left_out.py"}
    assert where["propagate"] == {"gsparc/processes/censored.py"}
