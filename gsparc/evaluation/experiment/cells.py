"""Which trainings a comparison consists of, and when one that was done before is still the same."""

from __future__ import annotations

import ast
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gsparc.data.instantiate import find, plugins, targets
from gsparc.evaluation.experiment.problem import Problem
from gsparc.models.registry import methods

ANY = "any"  # stands for the budget or seed of a method that has none


@dataclass(frozen=True)
class Contender:
    """A method as the comparison's configuration names it.

    Attributes:
        name: in tables.
        choose: overrides of train.yaml that select it.
        budget: overrides with `{budget_s}`; empty when its time cannot be chosen.
        kinds: of data it serves; empty for all.
        stations: takes part only where there are several stations, some rows of each being learned from.
        scene: takes part only where the measurements name the scene that they were made in.
        only_longest: too slow for any but the longest budget.
        timed_only: too slow to be scored at all: fitted for its latency.
    """

    name: str
    choose: tuple[str, ...]
    budget: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    stations: bool = False
    scene: bool = False
    only_longest: bool = False
    timed_only: bool = False

    def serves(self, problem: Problem) -> bool:
        """Whether it can take part."""
        kind = not self.kinds or problem.kind in self.kinds
        return kind and problem.stations >= self.stations and problem.scene >= self.scene

    def overrides(self, budget_s: float | None) -> list[str]:
        """Overrides of train.yaml, but for the seed."""
        timed = [] if budget_s is None else [text.format(budget_s=f"{budget_s:g}") for text in self.budget]
        return [*self.choose, *timed]


@dataclass(frozen=True)
class Cell:
    """One training and its result.

    Attributes:
        dataset, split, method: names.
        budget_s: seconds per model [s]; None for a method without budget.
        seed: of the method, and of the split where that is drawn several times; None for neither.
    """

    dataset: str
    split: str
    method: str
    budget_s: float | None
    seed: int | None

    def __str__(self) -> str:
        budget = ANY if self.budget_s is None else f"{self.budget_s:g}"
        return f"{self.dataset}/{self.split}/{self.method}/{budget}/{ANY if self.seed is None else self.seed}"


def plugged() -> dict[str, Contender]:
    """Methods that are plugins; a class may name the `kinds` of data that it serves."""
    found = {}
    for name, path in plugins("model").items():
        kind = find(path)
        if name not in methods() and kind is not None:  # one that cannot be imported is warned of
            budget = ("budget_s={budget_s}",) if kind.takes_budget else ()
            found[name] = Contender(name, (f"model={name}",), budget, tuple(getattr(kind, "kinds", ())))
    return found


@dataclass(frozen=True)
class Budget:
    """Seconds of training for every method that takes a budget.

    Attributes:
        seconds: per model [s]; a split of five folds trains five.
        seeds: one training each.
        splits: where it is given; empty for all.
    """

    seconds: float
    seeds: tuple[int, ...]
    splits: tuple[str, ...] = ()


def plan(
    problems: Sequence[Problem],
    methods: Mapping[str, Contender],
    budgets: Sequence[Budget],
    only: Sequence[str] = (),
) -> list[tuple[Problem, Cell]]:
    """All cells, the most useful first: every problem's table before further seeds and longer budgets.

    Args:
        problems: the most wanted first; one of several draws of a split gives a method its seed.
        methods: who takes part.
        budgets: the most wanted first.
        only: patterns of `str(cell)`; empty for all.

    Raises:
        ValueError: a pattern that no cell matches.
    """

    able = [(problem, [m for m in methods.values() if m.serves(problem)]) for problem in problems]
    chosen: list[tuple[Problem, Contender, float | None, int | None]] = []
    chosen += [(problem, m, None, None) for problem, those in able for m in those if not m.budget]
    longest = max((b.seconds for b in budgets), default=0.0)
    turns = max((len(b.seeds) for b in budgets), default=0)
    for turn in range(turns):  # first seeds of all budgets before second ones
        for budget in (b for b in budgets if turn < len(b.seeds)):
            for problem, those in able:
                if budget.splits and problem.split not in budget.splits:
                    continue
                if turn and problem.draw is not None:
                    continue
                chosen += [
                    (problem, m, budget.seconds, budget.seeds[turn])
                    for m in those
                    if m.budget and not (m.only_longest and (turn > 0 or budget.seconds < longest))
                ]
    cells = [
        (p, Cell(p.dataset, p.split, m.name, budget_s, seed if p.draw is None else p.draw))
        for p, m, budget_s, seed in chosen
    ]
    names = [str(cell) for _, cell in cells]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(
                f"only: {pattern!r} matches no cell; they are dataset/split/method/budget/seed, "
                f"like {names[0] if names else 'rfid/random/gp/any/any'}"
            )
    return [
        one
        for one, name in zip(cells, names, strict=True)
        if not only or any(fnmatchcase(name, pattern) for pattern in only)
    ]


def key(model: Mapping[str, Any], trainer: Mapping[str, Any], *hashes: str) -> str:
    """Name of a result: what it was learned from, by what settings and by which program text.

    Args:
        model: its whole configuration.
        trainer: settings of the training around it, where it has any.
        hashes: see `Problem`.
    """
    text = json.dumps([model, trainer, *hashes, code_version(model)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def code_version(model: Mapping[str, Any]) -> str:
    """Hash of the program text behind a model's configuration.

    That is every class it names, their bases, and what these import from their own packages. The shared
    ground (rasterizer, loaders, metrics) is not part of it: having changed that, start with an empty folder.
    """
    named = {base.__module__ for path in targets(model) for base in find(path).__mro__}
    own = {"gsparc", *(str(path).partition(".")[0] for path in targets(model))}  # plugins have texts too
    open_ends = {name for name in named if name.partition(".")[0] in own} - {"gsparc.models.method"}
    sources: dict[str, str] = {}
    while open_ends:
        name = open_ends.pop()
        spec = find_spec(name)
        if name in sources or spec is None or spec.origin is None or spec.submodule_search_locations:
            continue
        file = Path(spec.origin)
        sources[name], imported = _program(file, file.stat().st_mtime_ns)
        package = name.rpartition(".")[0]
        open_ends |= {m for m in imported if package and m.rpartition(".")[0] == package}
    return hashlib.sha256(json.dumps(sources, sort_keys=True).encode()).hexdigest()[:12]


@functools.cache
def _program(file: Path, changed_ns: int) -> tuple[str, frozenset[str]]:
    """A module's meaning and what it imports, read once for all cells while the file stays as it is."""
    tree = ast.parse(file.read_bytes())
    return _meaning(tree), frozenset(_imports(tree))


def _meaning(tree: ast.Module) -> str:
    """The program without layout, comments and docstrings: better words do not make another method."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                body[0] = ast.Pass()
    return ast.dump(tree)


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
