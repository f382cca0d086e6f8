"""`make grid`: every kind of data with defaults, resumable; a line of JSON for each,
and a table at the end.

python tests/grid/sweep.py RESULTS.jsonl            # the covering set: every pair of properties
meets python tests/grid/sweep.py RESULTS.jsonl --seed 7   # 100 combinations drawn by a seed
"""

import argparse
import csv
import json
import logging
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from judging import Outcome, repeated, run
from product import PARTS
from rich.console import Console
from worlds import World, covering, drawn, every

from gsparc.evaluation.table import Column, Table

MANY = 100


def one(world: World, folder: Path, more: tuple[str, ...]) -> tuple[Outcome, list[str]]:
    """What a world came to, on fresh seeds where the first is a miss, and what did not answer."""
    found, objects = run(world, 0, folder, more)
    failures = []
    if objects is None:
        return found, failures
    for part in PARTS:
        try:
            part(world, folder, objects)
        except Exception as error:
            failures.append(f"{part.__name__}: {type(error).__name__}: {str(error)[:200]}")
    return (repeated(world, folder, more) if found.behind else found), failures


HEADS = ("combination", "seconds", "fit s", "gsparc", "best plain", "allowed", "model", "verdict")


def outcome_of(entry: dict) -> Outcome:
    """A line of results without what did not answer."""
    return Outcome(**{key: value for key, value in entry.items() if key != "failures"})


def cells(entry: dict) -> tuple[str, ...]:
    """One result, as `HEADS` name it."""
    found = outcome_of(entry)
    verdict = found.refused or "; ".join(entry["failures"]) or ("behind" if found.behind else "")
    figures = (f"{found.own:.4g}", f"{found.name} {found.best:.4g}", f"{found.allowed:.2g}")
    model = found.model + (" (five seeds)" if found.seed < 0 else "")
    return found.world, f"{found.seconds:.0f}", f"{found.fit_s:.1f}", *figures, model, verdict


def main() -> int:
    """Exit status 1 where something was refused, behind or did not answer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument(
        "--seed", type=int, help="draw 100 combinations instead of the covering set"
    )
    parser.add_argument("--rows", type=int, nargs="+", default=[30, 300, 3000])
    parser.add_argument("--csv", type=Path, help="write the table, as docs/results/kinds.csv is")
    parser.add_argument("more", nargs="*", help="overrides, such as effort=.3")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    worlds = every(tuple(given.rows))
    chosen = covering(worlds) if given.seed is None else list(drawn(worlds, MANY, given.seed))
    given.results.parent.mkdir(parents=True, exist_ok=True)
    given.results.touch()
    done = [json.loads(line) for line in given.results.read_text().splitlines()]
    known, console = {entry["world"] for entry in done}, Console(width=220)
    for number, world in enumerate(chosen, 1):
        if world.name in known:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found, failures = one(world, Path(folder), tuple(given.more))
        done.append({**json.loads(found.line()), "failures": failures})
        with given.results.open("a") as file:
            file.write(json.dumps(done[-1]) + "\n")
        console.print(
            f"{number} of {len(chosen)}: {world.name}, {found.seconds:.0f} s", highlight=False
        )
    console.print(Table("kinds of data", [Column(head, "") for head in HEADS], [*map(cells, done)]))
    if given.csv is not None:
        with given.csv.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADS, *map(cells, done)])
    bad = [one for one in done if one["refused"] or one["failures"] or outcome_of(one).behind]
    plain = sum(entry["plain"] for entry in done)
    console.print(
        f"{len(done)} combinations, {len(bad)} with something wrong, {plain} no more than a "
        "plain process"
    )
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
