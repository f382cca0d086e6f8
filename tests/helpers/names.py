"""Names that runs write, and those that the tables of docs/reference explain."""

import csv
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from pages import ROOT

LISTS = ("console", "figures")
# Of json: hydra's own settings are explained in conf and in the classes,
# files and modules by their names.
ELSEWHERE = re.compile(r"(?:unread/)?(?:settings|files|program)/.*")
SUFFIX = re.compile(r"(?:_p\d+|_batch64| low| high| least| largest| error)$")


@cache
def explained() -> frozenset[str]:
    """Words of the tables, and first columns of the page of a run."""
    words = set(
        re.findall(r"`([\w/]+)`", (ROOT / "docs" / "understand.md").read_text(encoding="utf-8"))
    )
    for name in LISTS:
        with (ROOT / "docs" / "reference" / f"{name}.csv").open(
            encoding="utf-8", newline=""
        ) as file:
            words |= {
                word.strip(" `") for row in csv.reader(file) for word in re.split("[,;] ", row[0])
            }
            file.seek(0)
            words |= {row[0] for row in csv.reader(file)}  # some heads have commas
    return frozenset(words)


def find_unexplained(folder: Path) -> list[str]:
    """Return columns of csv and keys of json below a run's folder that no table explains."""
    found = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix == ".csv":
            with file.open(encoding="utf-8", newline="") as lines:
                found |= {name: file for name in next(csv.reader(lines), [])}
        elif file.suffix in (".json", ".geojson"):
            content = json.loads(file.read_text(encoding="utf-8"))
            found |= {name: file for name in _keys(content)} if isinstance(content, dict) else {}
    return [f"{file.name}: {name}" for name, file in found.items() if not _is_explained(name)]


def _keys(content: dict[str, Any], stem: str = "") -> Iterator[str]:
    for key, value in content.items():
        yield from (
            _keys(value, f"{stem}{key}/") if isinstance(value, dict) and value else [stem + key]
        )


def _is_explained(name: str) -> bool:
    parts = SUFFIX.sub("", name).split("/")
    tails = {"/".join(parts[i:]) for i in range(len(parts))} | {name.rpartition("/")[2], name}
    tails |= {"20%"} if name.endswith("%") else set()
    return bool(ELSEWHERE.match(name) or tails & explained())
