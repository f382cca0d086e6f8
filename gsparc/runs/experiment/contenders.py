"""Methods that a comparison trains, and which data each can be trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from gsparc.base.files import load_yaml
from gsparc.base.instantiate import import_target
from gsparc.evaluation.console import config_folder
from gsparc.models.registry import (
    all_methods,
    built_in_methods,
    method_class,
    plain_methods,
)
from gsparc.runs.experiment.problem import Problem


@dataclass(frozen=True)
class Contender:
    """A method as the comparison's configuration names it.

    Attributes:
        name: in tables.
        choose: overrides of train.yaml that select it; empty: `model=<name>`.
        effort: whether it takes part once for every effort and seed, or once.
        kinds: of data it serves; empty for all.
        problems: patterns of dataset/split that it takes part in; empty for all.
        given: what it reads beside places, by such patterns; the last one that matches counts.
        train_s: seconds that its fit takes at effort 1, as far as they are known [s].
        stations: takes part only where there are several stations, some rows of each being learned
            from.
        scene: takes part only where the measurements name the scene that they were made in.
        networks: takes part where stations are sectors of a network, which have one model whatever
            is chosen.
    """

    name: str
    choose: tuple[str, ...] = ()
    effort: bool = False
    kinds: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    given: Mapping[str, str] = field(default_factory=dict)
    train_s: float | None = None
    stations: bool = False
    scene: bool = False
    networks: bool = True

    def serves(self, problem: Problem) -> bool:
        """Return whether it can take part."""
        suits = not self.kinds or problem.kind in self.kinds
        suits &= not self.problems or any(
            fnmatchcase(problem.name, pattern) for pattern in self.problems
        )
        # Booleans compare as 0 and 1: what a method needs, the problem must have.
        needs = problem.stations >= self.stations and problem.scene >= self.scene
        return suits and needs and self.networks >= problem.network

    def reads(self, problem: Problem) -> str:
        """Return what it is given beside places; "" for nothing."""
        return (
            [option for where, option in self.given.items() if fnmatchcase(problem.name, where)]
            or [""]
        )[-1]

    def overrides(self, effort: float | None) -> list[str]:
        """Return overrides of train.yaml, but for the seed."""
        choice = self.choose or (f"model={self.name}",)
        return [*choice, *([] if effort is None else [f"effort={effort:g}"])]


class Unlisted(Contender):
    """A method that the configuration does not name: its class tells which data it serves."""

    def serves(self, problem: Problem) -> bool:
        """See `Contender.serves`."""
        kind, folds = method_class(self.name), problem.folds.folds
        return super().serves(problem) and all(
            kind.stands_beside(problem.data, fold) for fold in folds
        )


def unlisted_contenders() -> dict[str, Contender]:
    """Return those of plugins and plain methods that conf/compare.yaml does not name."""
    # The file, not the settings: `~methods.gp` on a command line leaves it out.
    file = config_folder() / "compare.yaml"
    listed = load_yaml(file.read_text(encoding="utf-8"), file)["methods"]
    exclusions = {*listed, *({*built_in_methods()} - {*plain_methods()})}
    classes = {
        name: import_target(path) for name, path in all_methods().items() if name not in exclusions
    }
    # One that cannot be imported is warned of.
    return {
        name: Unlisted(name, effort=method.takes_effort)
        for name, method in classes.items()
        if method
    }
