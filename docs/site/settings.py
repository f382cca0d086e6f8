"""Every setting of conf/ as a page: its comment, or what the docstring of a class says of it."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from cells import cell, in_cells

from gsparc.base.instantiate import config_node, import_target

CONF = Path(__file__).parents[2] / "conf"
LEFT_OUT = {"hydra", "defaults", "_target_"}
LONGEST = 80  # letters of a default that is shown as it is
Row = tuple[str, str, str]


def list_files() -> str:
    """Return all files with their settings in Markdown: commands first, then groups by name."""
    texts = []
    files = sorted(
        CONF.rglob("*.yaml"), key=lambda file: (file.parent != CONF, file.relative_to(CONF).parts)
    )
    for group in dict.fromkeys(map(_group, files)):
        texts.append(f"## {group or 'Commands'}")
        for file in (file for file in files if _group(file) == group):
            path = file.relative_to(CONF).with_suffix("")
            title = f"{group}={path.relative_to(group)}" if group else f"gsparc {path}"
            texts += [f"### `{title}`", _first_lines(file)]
            if rows := list_settings(file):
                coded = [
                    (f"`{name}`", default and f"`{default}`", text) for name, default, text in rows
                ]
                texts.append(in_cells([("setting", "default", "what it is"), *coded]))
    return "\n\n".join(texts)


def _group(file: Path) -> str:
    return "" if file.parent == CONF else file.relative_to(CONF).parts[0]


def list_settings(file: Path) -> list[Row]:
    """Return name, default and meaning of each setting of a file, named as on the command line."""
    text = file.read_text(encoding="utf-8")
    node = yaml.compose(text)
    if not isinstance(node, yaml.MappingNode):
        return []
    group = "" if text.startswith("# @package _global_") else _group(file)
    return list(_walk(node, text.splitlines(), group and f"{group}."))


def _walk(node: yaml.MappingNode, lines: list[str], prefix: str) -> Iterator[Row]:
    given = {key.value: (key, value) for key, value in node.value}
    for name, (key, value) in given.items():
        said = _comment(key, value, lines)
        block = isinstance(value, yaml.MappingNode) and not value.flow_style
        if name in LEFT_OUT or (name == "name" and not said):
            continue
        if said:  # entries of comparisons have none
            yield f"{prefix}{name}", "" if block else _default(value, lines), said
        if block:
            yield from _walk(value, lines, f"{prefix}{name}.")
    target = given["_target_"][1].value if "_target_" in given else ""
    kind = import_target(target) if target.startswith("gsparc.") else None
    if isinstance(kind, type):
        yield from _of_class(config_node(kind), prefix, given)


def _of_class(node: Mapping[str, Any], prefix: str, given: Mapping[str, Any]) -> Iterator[Row]:
    """Yield settings with defaults that a class takes and its file does not give."""
    meanings = _described(import_target(node["_target_"]))
    for name, default in node.items():
        if name in given or name in ("_target_", "name") or default == "???":
            continue
        if isinstance(default, Mapping) and "_target_" in default:
            yield from _of_class(default, f"{prefix}{name}.", {})
        else:
            shown = default if isinstance(default, str) else json.dumps(default)
            yield f"{prefix}{name}", shown, meanings.get(name, "").rstrip(".")


def _described(kind: type) -> dict[str, str]:
    """Return what docstrings of a class, its bases and whose settings it hands on say
    of each argument.
    """
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if "hands_on" in vars(one):
            found |= _described(vars(one)["hands_on"])
        for text in (one.__doc__, getattr(vars(one).get("__init__"), "__doc__", None)):
            for section in re.findall(
                r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)", inspect.cleandoc(text or ""), re.M
            ):
                for names, meaning in re.findall(
                    r"^    ([\w, ]+): (.+(?:\n     .+)*)", section, re.M
                ):
                    own = dict.fromkeys(re.split(", *", names), " ".join(meaning.split()))
                    named = re.match(r"see `(\w+)`", meaning)
                    other = vars(sys.modules[one.__module__]).get(named[1]) if named else None
                    more = _described(other) if isinstance(other, type) else {}
                    found |= own | {name: text for name, text in more.items() if name in own}
    return found


def _default(value: yaml.Node, lines: list[str]) -> str:
    first, last = value.start_mark, value.end_mark
    if first.line != last.line:
        return "..."
    text = lines[first.line][first.column : last.column]
    return text if len(text) <= LONGEST else "..."


def _comment(key: yaml.Node, value: yaml.Node, lines: list[str]) -> str:
    """Return what stands beside a setting and goes on beneath, far to the right;
    else what is above it.
    """
    row, column = key.start_mark.line, key.start_mark.column
    alone = value.end_mark.line == row
    beside = re.search(
        r"(?:^|\s)# (.*)$", lines[row][value.end_mark.column if alone else key.end_mark.column :]
    )
    if beside:
        texts = [beside[1]]
        for line in lines[row + 1 :]:
            if not re.match(rf"\s{{{column + 8},}}# ", line):
                break
            texts.append(line.strip().lstrip("# "))
        return " ".join(texts)
    above = []
    while row and re.match(rf"\s{{{column}}}# ", lines[row - 1]):
        row -= 1
        above.insert(0, lines[row].strip().lstrip("# "))
    return " ".join(above) if row else ""  # else it is the file's


def _first_lines(file: Path) -> str:
    """Return the comments that a file begins with."""
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines += [cell(line.lstrip("# "))] * (not line.startswith("# @package"))
    return "  \n".join(lines)
