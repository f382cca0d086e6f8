"""Tables of Markdown that show their cells as they are written."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path


def table(path: Path) -> str:
    """Return a CSV file as a table in Markdown, names in its first column as code."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return in_cells([head, *((re.sub(r"^\w+$", r"`\g<0>`", name), *rest) for name, *rest in rows)])


def in_cells(rows: Sequence[Sequence[str]]) -> str:
    """Return rows, the first of heads, as a table that shows what is written,
    and code between backticks.
    """
    head, *others = ([cell(text) for text in row] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *others))


def cell(text: str) -> str:
    """Return a text without what would end its cell, or be taken for Markdown outside of code."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(
        part if part[:1] == "`" else re.sub(r"[|*_\[\]<&\\]", _entity, part) for part in parts
    )


def _entity(found: re.Match[str]) -> str:
    return f"&#{ord(found[0])};"
