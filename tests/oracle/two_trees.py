"""`make oracle BASE=COMMIT`: what fits and answers of the problems moved since a commit,
on this machine.
"""

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fits import missed, moved, read
from problems import PROBLEMS, parted
from rich.console import Console

ROOT = Path(__file__).parents[2]
# Of the targets' deviation: answers, and those of closed forms in float64
ANSWERED, DOUBLE = 1e-5, 1e-8
FIGURES = 1e-4
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")


def changed(old: Any, new: Any, name: str = "") -> list[str]:
    """Figures and choices that differ by more than is allowed, one line each."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(old.keys() | new.keys())
        return [
            line
            for key in keys
            for line in changed(old.get(key), new.get(key), f"{name} {key}".strip())
        ]
    texts = [str(each) for each in (old, new)]
    same = NUMBER.sub("#", texts[0]) == NUMBER.sub("#", texts[1])
    pairs = zip(*(NUMBER.findall(text) for text in texts), strict=False)
    same = same and all(
        abs(float(a) - float(b)) <= FIGURES * abs(float(a)) + 1e-9 for a, b in pairs
    )
    return [] if same else [f"{name}: {old} -> {new}"]


def built(commit: str) -> Path:
    """The tree of a commit, checked out beside this one's builds,
    with an environment of its own.
    """
    whole = subprocess.check_output(
        ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"], cwd=ROOT, text=True
    )
    tree = ROOT / "build" / "oracle" / whole[:12]
    if not tree.exists():
        added = [
            "git",
            "worktree",
            "add",
            "--quiet",
            "--force",
            "--detach",
            str(tree),
            whole.strip(),
        ]
        subprocess.run(added, cwd=ROOT, check=True)
    subprocess.run(["make", "--quiet", "setup"], cwd=tree, check=True)
    return tree


def main(commit: str, names: list[str]) -> None:
    """Fit and ask the problems in both trees, and print what moved, old -> new."""
    console, started, base = Console(width=200, highlight=False), time.monotonic(), built(commit)
    sides = []
    for tree, folder in ((base, base.with_suffix(".base")), (ROOT, base.with_suffix(".here"))):
        asking = [tree / ".venv/bin/python", Path(__file__).with_name("fits.py"), folder, *names]
        subprocess.run([str(word) for word in asking], cwd=tree, check=True)
        sides.append(read(folder))
    (told, figures), (told_here, figures_here) = sides
    for name in names or PROBLEMS:
        asked = parted(PROBLEMS[name].arrays())[1]
        lines = moved(told[name], told_here[name], asked, ANSWERED, DOUBLE)
        lines += changed(figures[name], figures_here[name])
        errors = (missed(each[name], asked) for each in (told, told_here))
        console.print(
            f"{name}: error {' -> '.join(f'{error:.4f}' for error in errors)} of the deviation"
        )
        for line in lines:
            console.print(f"  {line}", markup=False)
    console.print(
        f"{len(names or PROBLEMS)} problems in {(time.monotonic() - started) / 60:.1f} minutes"
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
