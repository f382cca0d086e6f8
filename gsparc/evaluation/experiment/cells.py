"""Which fits a comparison consists of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import Any

from gsparc.data.instantiate import import_target, plugins
from gsparc.evaluation.experiment.problem import Problem, compose
from gsparc.evaluation.experiment.runner import Job
from gsparc.models.registry import built_in_methods

FREE_S, EFFORT_S = 5.0, 60.0  # guessed for a method that counts nothing; for one of effort 1
ANY = "any"  # stands for the effort or seed of a method that has none


@dataclass(frozen=True)
class Contender:
    """A method as the comparison's configuration names it.

    Attributes:
        name: in tables.
        choose: overrides of train.yaml that select it; empty: `model=<name>`.
        effort: whether it takes part once for every effort and seed, or once.
        kinds: of data it serves; empty for all.
        stations: takes part only where there are several stations, some rows of each being learned from.
        scene: takes part only where the measurements name the scene that they were made in.
        networks: takes part where stations are sectors of a network, which have one model whatever is chosen.
    """

    name: str
    choose: tuple[str, ...] = ()
    effort: bool = False
    kinds: tuple[str, ...] = ()
    stations: bool = False
    scene: bool = False
    networks: bool = True

    def serves(self, problem: Problem) -> bool:
        """Return whether it can take part."""
        kind = not self.kinds or problem.kind in self.kinds
        # Booleans compare as 0 and 1: what a method needs, the problem must have.
        needs = problem.stations >= self.stations and problem.scene >= self.scene
        return kind and needs and self.networks >= problem.network

    def overrides(self, effort: float | None) -> list[str]:
        """Return overrides of train.yaml, but for the seed."""
        own = self.choose or (f"model={self.name}",)
        return [*own, *([] if effort is None else [f"effort={effort:g}"])]


@dataclass(frozen=True)
class Cell:
    """One training and its result.

    Attributes:
        dataset, split, method: names.
        effort: that what it counts is multiplied by; None for a method that counts nothing.
        seed: of the method, and of the split where that is drawn several times; None for neither.
        draws: whether its seed is a draw of the split.
    """

    dataset: str
    split: str
    method: str
    effort: float | None
    seed: int | None
    draws: bool = False

    def __str__(self) -> str:
        effort = ANY if self.effort is None else f"{self.effort:g}"
        return f"{self.dataset}/{self.split}/{self.method}/{effort}/{ANY if self.seed is None else self.seed}"


def plugin_contenders() -> dict[str, Contender]:
    """Return methods that are plugins; a class may name the `kinds` of data that it serves."""
    found = {}
    for name, path in plugins("model").items():
        kind = import_target(path)
        if name not in built_in_methods() and kind is not None:  # one that cannot be imported is warned of
            found[name] = Contender(name, (), kind.takes_effort, tuple(getattr(kind, "kinds", ())))
    return found


def plan_cells(
    problems: Sequence[Problem], methods: Mapping[str, Contender], efforts: Sequence[float],
    seeds: Sequence[int], only: Sequence[str] = (),
) -> list[tuple[Problem, Cell]]:  # fmt: skip
    """List all cells, the most useful first: every problem's table before further efforts and seeds.

    Args:
        problems: the most wanted first; one of several draws of a split gives a method its seed.
        methods: who takes part.
        efforts, seeds: the most wanted first; a method that counts nothing takes part once.
        only: patterns of `str(cell)`; empty for all.

    Raises:
        ValueError: a pattern that no cell matches.
    """
    able = [(problem, [m for m in methods.values() if m.serves(problem)]) for problem in problems]
    # Methods that count nothing first: they stand in the tables of all efforts.
    once = ((p, m) for p, those in able for m in those if not m.effort)
    cells = [(p, Cell(p.dataset, p.split, m.name, None, p.draw, p.draw is not None)) for p, m in once]
    for turn, seed in enumerate(seeds):
        for effort, (problem, those) in product(efforts, able):
            # A drawn split has its draws for seeds: further seeds would repeat the first draw.
            if turn and problem.draw is not None:
                continue
            own = seed if problem.draw is None else problem.draw
            named = ((problem.dataset, problem.split, m.name) for m in those if m.effort)
            cells += [(problem, Cell(*name, effort, own, problem.draw is not None)) for name in named]
    names = [str(cell) for _, cell in cells]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(
                f"only: {pattern!r} matches no cell; they are dataset/split/method/effort/seed, "
                f"like {names[0] if names else 'rfid/random/gp/any/any'}"
            )
    return [one for one in cells if not only or any(fnmatchcase(str(one[1]), part) for part in only)]


def job_of_cell(
    cell: Cell, contender: Contender, settings: Mapping[str, Any], problem: Problem, cells_dir: Path,
    reuse: bool = False,
) -> Job:  # fmt: skip
    """Compose a cell's configuration and name its folder, `dataset/split/method/effort/seed`.

    Of a split that is drawn several times, models of the first draw are kept: queries are timed with those.
    """
    overrides = [*problem.chosen, *contender.overrides(cell.effort)]
    config = compose(settings, overrides, problem.draw, cell.seed)
    # Two seconds for loading and scoring a fold; time left and `limit_s` go by this.
    fit_s = 2.0 + (FREE_S if cell.effort is None else EFFORT_S * cell.effort)
    return Job(
        cell, config, cells_dir / str(cell), problem.data, problem.folds, problem.content,
        expected_s=len(problem.folds.folds) * fit_s, keeps_models=not problem.draw, reuse=reuse,
    )  # fmt: skip
