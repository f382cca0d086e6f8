"""Lines by package, physical and of code (no docstrings, comments, blanks): `python bench/lines.py`."""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = {".py", ".cpp", ".h", ".cu", ".cuh", ".pyi", ".js", ".css", ".html", ".svg", ".sh"}
BLANK = {getattr(tokenize, name) for name in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}


def code(text: str) -> int:
    """Lines of Python that hold anything but docstrings and comments."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        alone = node.value if isinstance(node, ast.Expr) else None
        if isinstance(alone, ast.Constant) and alone.value is not None:
            documented |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in BLANK:
            used |= set(range(token.start[0], token.end[0] + 1))
    return len(used - documented)


def other_code(text: str) -> int:
    """The same of C++, CUDA and the rest."""
    lines = (line.strip() for line in text.splitlines())
    return sum(bool(line) and not line.startswith(("//", "/*", "*", "#", "<!--")) for line in lines)


def main() -> None:
    """Print a table."""
    packages = [*sorted(p for p in (ROOT / "gsparc").iterdir() if p.is_dir() and p.name != "__pycache__")]
    packages += [ROOT / name for name in ("ops", "callbacks", "bench", "train.py")]
    total = [0, 0]
    for package in packages:
        files = [package] if package.is_file() else [f for f in package.rglob("*") if f.suffix in SOURCE]
        texts = {file: file.read_text(encoding="utf-8") for file in files}
        physical = sum(text.count("\n") for text in texts.values())
        own = sum(code(text) if file.suffix == ".py" else other_code(text) for file, text in texts.items())
        total = [total[0] + physical, total[1] + own]
        sys.stdout.write(f"{package.relative_to(ROOT).as_posix():<24}{physical:>8}{own:>8}\n")
    sys.stdout.write(f"{'all':<24}{total[0]:>8}{total[1]:>8}\n")


if __name__ == "__main__":
    main()
