"""FILE.columns.yaml: what each column of a table is taken for, to be read and changed by people."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from gsparc.base.errors import DataError
from gsparc.base.files import read_text
from gsparc.tables.heads import KINDS
from gsparc.tables.roles import NONE, Role, Said

OPEN, UNUSED = "?", "unused"  # roles
ABOUT = """\
# What gsparc takes the columns of {file} for. Change a role (or a column, as dataset.columns takes
# it), and training follows. `?` is open: training stops, and says what it may be.
"""


def beside(path: str | Path) -> Path:
    """Return where the file about a table's columns is written."""
    return Path(f"{path}.columns.yaml")


def edited_beside(path: str | Path) -> Path | None:
    """Return the file about a table's columns beside it, where somebody edited it: it is taken."""
    return about if (about := beside(path)).is_file() and is_edited(about) else None


def hash_heads(heads: Sequence[str]) -> str:
    """Return a short hash of the heads of a table."""
    return hashlib.sha256("\n".join(heads).encode()).hexdigest()[:12]


def write_columns(path: str | Path, roles: Sequence[Role], heads: Sequence[str]) -> str:
    """Write what columns are taken for beside their table, unless somebody edited it;
    return one line that says so.
    """
    to = beside(path)
    if edited_beside(path):
        return f"{to} was edited, and is taken"
    asked = {name: role for role in roles for answer in role.readings for name in answer.said}
    lines = []
    for role in [role for role in roles if not role.readings]:
        name = OPEN if role.role in asked else role.role or UNUSED
        entry: dict[str, object] = {"column": role.column, "role": name}
        if role.role in asked:
            question = asked[role.role]
            may_be = [str(answer) for answer in question.readings]
            entry |= {"likely": role.role, "sure": question.sure, "may be": may_be}
        else:
            entry["sure"] = role.sure
        entry |= {"unit": role.unit} if role.unit else {}
        entry["values"] = [*role.values]
        text = yaml.safe_dump(entry, default_flow_style=True, width=10**6, sort_keys=False)
        lines.append(f"- {text}")
    body = ABOUT.format(file=Path(path).name) + f"heads: {hash_heads(heads)}\ncolumns:\n"
    body += "".join(lines)
    try:
        to.write_text(f"{body}written: {_hash(body)}\n", encoding="utf-8")
    except OSError as error:
        return f"{to}: cannot be written ({error.strerror or error})"
    return f"{to} says what each is taken for; change a role there, and training follows"


def _hash(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()[:12]


def is_edited(path: Path) -> bool:
    """Tell whether a file about columns is not as it was written."""
    body, _, written = path.read_text(encoding="utf-8").rpartition("written: ")
    return written.strip() != _hash(body)


def read_columns(path: Path, heads: Sequence[str]) -> Said:
    """Return columns by quantity, as a file about a table with these heads says;
    what it does not say is none, unless something in it is open.

    Raises:
        DataError: it is none, or the table has other heads.
    """
    try:
        content = yaml.safe_load(read_text(path, "no such file"))
        entries: list[Mapping[str, Any]] = [*content["columns"]]
        roles = [(str(entry["role"]), entry["column"]) for entry in entries]
    except (yaml.YAMLError, KeyError, TypeError) as error:
        raise DataError(f"{path}: no file about columns ({type(error).__name__})") from None
    if content.get("heads") != hash_heads(heads):
        raise DataError(f"{path}: the table's heads changed since; remove it, and check anew")
    for role, column in roles:
        if role not in (OPEN, UNUSED, *KINDS):
            raise DataError(
                f"{path}: {column}: {role!r} is no quantity; known are {', '.join(KINDS)}"
            )
    open_roles = any(role == OPEN for role, _ in roles)
    said: dict[str, object] = {} if open_roles else dict.fromkeys(KINDS, NONE)
    for role, column in roles:
        if role in KINDS:
            before = said.get(role, NONE)
            said[role] = column if before == NONE else f"{before}+{column}"
    return said
