"""Which trainings a comparison consists of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from gsparc.data.instantiate import import_target, plugins
from gsparc.evaluation.experiment.problem import Problem
from gsparc.models.registry import built_in_methods

ANY = "any"  # stands for the budget or seed of a method that has none


@dataclass(frozen=True)
class Contender:
    """A method as the comparison's configuration names it.

    Attributes:
        name: in tables.
        choose: overrides of train.yaml that select it; empty: `model=<name>`.
        budget: overrides with `{budget_s}`; empty when its time cannot be chosen.
        kinds: of data it serves; empty for all.
        stations: takes part only where there are several stations, some rows of each being learned from.
        scene: takes part only where the measurements name the scene that they were made in.
        networks: takes part where stations are sectors of a network, which have one model whatever is chosen.
        only_longest: too slow for any but the longest budget.
    """

    name: str
    choose: tuple[str, ...] = ()
    budget: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    stations: bool = False
    scene: bool = False
    networks: bool = True
    only_longest: bool = False

    def serves(self, problem: Problem) -> bool:
        """Return whether it can take part."""
        kind = not self.kinds or problem.kind in self.kinds
        # Booleans compare as 0 and 1: what a method needs, the problem must have.
        needs = problem.stations >= self.stations and problem.scene >= self.scene
        return kind and needs and self.networks >= problem.network

    def overrides(self, budget_s: float | None) -> list[str]:
        """Return overrides of train.yaml, but for the seed."""
        timed = [] if budget_s is None else [text.format(budget_s=f"{budget_s:g}") for text in self.budget]
        return [*(self.choose or (f"model={self.name}",)), *timed]


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


def plugin_contenders() -> dict[str, Contender]:
    """Return methods that are plugins; a class may name the `kinds` of data that it serves."""
    found = {}
    for name, path in plugins("model").items():
        kind = import_target(path)
        if name not in built_in_methods() and kind is not None:  # one that cannot be imported is warned of
            budget = ("budget_s={budget_s}",) if kind.takes_budget else ()
            found[name] = Contender(name, (), budget, tuple(getattr(kind, "kinds", ())))
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


def plan_cells(
    problems: Sequence[Problem], methods: Mapping[str, Contender], budgets: Sequence[Budget],
    only: Sequence[str] = (),
) -> list[tuple[Problem, Cell]]:  # fmt: skip
    """List all cells, the most useful first: every problem's table before further seeds and longer budgets.

    Args:
        problems: the most wanted first; one of several draws of a split gives a method its seed.
        methods: who takes part.
        budgets: the most wanted first, which splits that none of them names have, too.
        only: patterns of `str(cell)`; empty for all.

    Raises:
        ValueError: a pattern that no cell matches.
    """
    able = [(problem, [m for m in methods.values() if m.serves(problem)]) for problem in problems]
    # Methods without a budget first: they stand in the tables of all budgets.
    once = ((p, m) for p, those in able for m in those if not m.budget)
    cells = [(p, Cell(p.dataset, p.split, m.name, None, p.draw)) for p, m in once]
    longest = max((b.seconds for b in budgets), default=0.0)
    # First seeds of all budgets before second ones.
    turns = ((n, b) for n in range(max((len(b.seeds) for b in budgets), default=0)) for b in budgets)
    named = {split for budget in budgets for split in budget.splits}
    for turn, budget in ((n, b) for n, b in turns if n < len(b.seeds)):
        for problem, those in able:
            # A split that no budget names has the first: a table without our row would mislead.
            of = not budget.splits or problem.split in budget.splits
            of |= budget is budgets[0] and problem.split not in named
            # A drawn split has its draws for seeds: further seeds would repeat the first draw.
            if not of or (turn and problem.draw is not None):
                continue
            seed = budget.seeds[turn] if problem.draw is None else problem.draw
            cells += [
                (problem, Cell(problem.dataset, problem.split, m.name, budget.seconds, seed))
                for m in those
                if m.budget and not (m.only_longest and (turn > 0 or budget.seconds < longest))
            ]
    names = [str(cell) for _, cell in cells]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(
                f"only: {pattern!r} matches no cell; they are dataset/split/method/budget/seed, "
                f"like {names[0] if names else 'rfid/random/gp/any/any'}"
            )
    return [one for one in cells if not only or any(fnmatchcase(str(one[1]), part) for part in only)]
