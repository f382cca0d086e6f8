"""Dry run: which files are read without a question, asked about, or refused.

    PYTHONPATH=tests/helpers python tests/helpers/asked_table.py [FILE ...]

Without names: all measured files, the tables of `strangers.py`, and twenty of `clean_tables.py`.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from clean_tables import write
from releases import REAL
from strangers import CASES

from gsparc.base.errors import DataError
from gsparc.datasets.own import read_any

SUFFIXES = {".csv", ".npz", ".h5", ".json", ".pkl"}
LISTS = ("truth", "sites", "cells", "places", "index", "c11_gw")  # in stems of what is no log
SITES = {"h01": "h01_sites", "h13": "h01_sites", "c11_": "c11_gw", "silent": "silent_sites"}


def files(folder: Path) -> Iterator[tuple[str, Path, dict]]:
    """What is looked at: its name, the file, and the settings that its maker would give."""
    for path in sorted(REAL.rglob("*.*")):
        if path.suffix in SUFFIXES and not any(word in path.stem for word in LISTS):
            lists = [path.with_name(f"{SITES[s]}.csv") for s in SITES if path.stem.startswith(s)]
            yield str(path.relative_to(REAL)), path, {"stations_file": lists[0]} if lists else {}
    for number, (name, (content, settings, *_)) in enumerate(CASES.items()):
        (path := folder / f"case{number}.csv").write_text(content)
        yield f"case: {name}", path, settings
    yield from ((f"clean: {seed}", write(seed, folder), {}) for seed in range(20))


def outcome(path: Path, settings: dict) -> tuple[str, str]:
    """`read`, `asked` or `refused`, and the first question or problem."""
    try:
        notes = read_any(path, **settings, guess=True).notes
    except DataError as error:
        return "refused", error.problems[0].replace(f"{path.parent}/", "")
    questions = [note for note in notes if type(note).__name__ == "Question"]
    return ("asked", questions[0]) if questions else ("read", "")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        given = [(name, Path(name), {}) for name in sys.argv[1:]]
        for name, path, settings in given or files(Path(folder)):
            sys.stdout.write("\t".join((name, *outcome(path, settings))) + "\n")
