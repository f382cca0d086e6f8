"""The list of hard cases, and that each has its file, its remedy and a test that its naive formula fails."""

import ast
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CASES = (
    *("seam", "pole", "horizon", "at the receiver", "at the transmitter", "needle pancake",
        "zero quaternion"),
    *("near opaque", "underflow", "ties", "nobody there", "everybody there", "confidence overflow"),
    *("flat images", "silent channel", "carrier phase", "far from the origin", "half precision", "poison"),
    *("surgery", "resume", "threads"),
)  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_it_has_a_file_that_says_why(case):
    tree = ast.parse((HERE / f"test_{case.replace(' ', '_')}.py").read_text())
    said = (ast.get_docstring(tree) or "").lower()
    assert said.startswith(case.split()[0]) and "remedy: " in said, case
    assert any(word in said for word in ("tolerance", "exact", "within", "bit", "by the same")), case
    tests = [
        node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    able_to_fail = [t.name for t in tests if "naive" in f"{t.name} {ast.get_docstring(t)}".lower()]
    assert len(tests) >= 2 and (able_to_fail or any(t.name.endswith("break") for t in tests)), case
