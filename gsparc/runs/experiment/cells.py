"""Which fits a comparison consists of: methods by measurements by rows that learn and test."""

from __future__ import annotations

import functools
import logging
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import hydra
from omegaconf import DictConfig, OmegaConf

from gsparc.base.instantiate import from_settings
from gsparc.base.limits import POSITIVE
from gsparc.data.schema import Measurements
from gsparc.datasets.load import load, split_for
from gsparc.datasets.public.fetch import fetched_path_or_none
from gsparc.evaluation.console import to_dict
from gsparc.models.registry import (
    fill_defaults,
)
from gsparc.runs.experiment.contenders import Contender, unlisted_contenders
from gsparc.runs.experiment.options import REDRAW
from gsparc.runs.experiment.problem import Problem
from gsparc.runs.experiment.runner import Job
from gsparc.runs.ledger import measurements_hash

log = logging.getLogger(__name__)

Entry = TypeVar("Entry")
FREE_S, EFFORT_S = 5.0, 60.0  # guessed for a method that counts nothing; for one of effort 1
ANY = "any"  # stands for the effort or seed of a method that has none


@dataclass(frozen=True)
class SplitChoice:
    """A split as the comparison's configuration names it.

    Attributes:
        name: in tables.
        choose: overrides of train.yaml that select it; empty: `split=<name>`.
        datasets: that are cut so; empty for all.
        draws: how often it is drawn, by `split.seed` from 0; 0: once, with the seed it has.
    """

    name: str
    choose: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    draws: int = 0

    @property
    def overrides(self) -> tuple[str, ...]:
        """Overrides of train.yaml, but for the draw."""
        return self.choose or (f"split={self.name}",)

    @property
    def numbers(self) -> tuple[int | None, ...]:
        """Every draw, or None for the only one."""
        return tuple(range(self.draws)) or (None,)


def read_entries(group: str, of: type[Entry], config: Mapping[str, Any]) -> dict[str, Entry]:
    """Return named settings of conf/compare.yaml, `methods` or `splits`;
    one that is null is left out.

    Raises:
        ValueError: an entry with an unknown setting.
    """
    entries = {}
    for name, entry in config.items():
        if entry is None:
            continue
        values = {
            k: tuple(v) if isinstance(v, (list, tuple)) else v for k, v in dict(entry).items()
        }
        entries[str(name)] = from_settings(of, {"name": str(name), **values}, f"{group}.{name}")
    return entries


def load_problems(
    name: str, settings: Mapping[str, Any], splits: Sequence[SplitChoice]
) -> list[Problem]:
    """Load what `conf/dataset` names, with the given settings, once for all draws of all splits."""
    read: tuple[Measurements, str] | None = None
    problems = []
    for split in splits:
        chosen = (f"dataset={settings.get('dataset', name)}", *split.overrides)
        for draw in split.numbers:
            config = compose(settings, chosen, draw)
            # Measurements are read once: splits and draws choose rows of the same arrays.
            if read is None:
                data = load(to_dict(config.dataset))
                read = data, measurements_hash(data)
            folds = split_for(to_dict(config.split), read[0])
            problems.append(Problem(name, split.name, chosen, read[0], folds, read[1], draw))
        if folds.of_release and split.draws > 1:
            log.warning(
                "%s, split %s: draws move validation rows alone: %s", name, split.name, REDRAW
            )
    return problems


def compose(
    settings: Mapping[str, Any],
    overrides: Sequence[str],
    draw: int | None = None,
    seed: int | None = None,
) -> DictConfig:
    """Return the configuration `train.py` would see.

    Args:
        settings: of its dataset; `dataset` is the choice itself, and left out.
        overrides: of train.yaml.
        draw: `split.seed`; None: as the split has it.
        seed: None: 0.
    """
    # A copy: the composed configuration is cached and shared by all draws.
    config = deepcopy(_composed(tuple(overrides)))
    dataset_settings = {name: value for name, value in settings.items() if name != "dataset"}
    OmegaConf.update(config, "dataset", dataset_settings, merge=True)
    OmegaConf.update(config, "seed", seed or 0)
    if draw is not None:
        OmegaConf.update(config, "split.seed", draw)
    return config


@functools.cache
def _composed(overrides: tuple[str, ...]) -> DictConfig:
    """Composing takes half a second, and draws differ in numbers only."""
    # Baselines are cells of their own here, and pictures of every cell nobody looks at.
    chosen = ["logger=none", "baselines=[]", "~callbacks.pictures", *overrides]
    config = hydra.compose("train", overrides=[*chosen, "hydra.run.dir=."])
    fill_defaults(config.model)
    return config


def load_every_problem(settings: Mapping[str, Any]) -> list[Problem]:
    """Load every dataset under every split that is meant for it, first draws first:
    the best-known come first.

    Raises:
        ValueError: no dataset has a path, or none of those that have one is wanted.
    """
    wanted = wanted_cells(settings)
    splits = read_entries("splits", SplitChoice, settings["splits"])
    problems, absent = list[Problem](), list[str]()
    for name, entry in ((name, entry or {}) for name, entry in settings["datasets"].items()):
        locations = [path for key, path in entry.items() if key in ("root", "file")]
        paths = [path or fetched_path_or_none(entry.get("dataset", name)) for path in locations]
        # A plugin's dataset may need none, whatever else is said of it
        if paths and not any(paths):
            absent.append(name)
            continue
        choices = [
            split
            for split in splits.values()
            if (not split.datasets or name in split.datasets)
            and (not wanted or any(_may_match(p, name, split.name) for p in wanted))
        ]
        problems += load_problems(name, entry, choices) if choices else []
    if absent:
        how = "left out: say datasets.NAME.root=DIR or .file=FILE, or gsparc data"
        log.warning("%s %s", ", ".join(absent), how)
    order = list(splits)
    # Sort is stable: datasets keep the order in which they are named.
    problems.sort(key=lambda problem: (problem.draw or 0, order.index(problem.split)))
    if not problems and len(absent) == len(settings["datasets"]):
        raise ValueError(
            "no dataset has a path; say datasets.rfid.root=DIR or datasets.newrf.file=FILE"
        )
    if not problems:
        raise ValueError(f"only={settings['only']}: matches no dataset and split that are there")
    return problems


def wanted_cells(settings: Mapping[str, Any]) -> list[str]:
    """Return the patterns of `only`, which may be the name of one of the comparison's `parts`.

    Raises:
        ValueError: a name that no part has.
    """
    only, parts = settings["only"], settings["parts"]
    if not isinstance(only, str):
        return [str(pattern) for pattern in only]
    if only not in parts:
        have = ", ".join(parts) or "no part here"
        raise ValueError(f"only={only}: a list of patterns, or the name of a part ({have})")
    return [str(pattern) for pattern in parts[only]]


def _may_match(pattern: str, dataset: str, split: str) -> bool:
    """Whether a pattern of cells can match this problem, so that others need not be loaded."""
    # Up to the first of its signs, which may stand for all that follows.
    fixed, name = re.split(r"[*?[]", pattern)[0], f"{dataset}/{split}/"
    return name.startswith(fixed) or fixed.startswith(name)


@dataclass(frozen=True)
class Cell:
    """One training and its result.

    Attributes:
        dataset, split, method: names.
        effort: that what it counts is multiplied by; None for a method that counts nothing.
        seed: of the method, and of the split where that is drawn several times; None for neither.
        draws: whether its seed is a draw of the split.
        given: what the method reads beside places.
    """

    dataset: str
    split: str
    method: str
    effort: float | None
    seed: int | None
    draws: bool = False
    given: str = ""

    def __str__(self) -> str:
        effort = ANY if self.effort is None else f"{self.effort:g}"
        seed = ANY if self.seed is None else self.seed
        return f"{self.dataset}/{self.split}/{self.method}/{effort}/{seed}"


def plan_cells(
    problems: Sequence[Problem],
    methods: Mapping[str, Contender],
    efforts: Sequence[float],
    seeds: Sequence[int],
    only: Sequence[str] = (),
) -> list[tuple[Problem, Cell]]:
    """List all cells, the most useful first:
    every problem's table before further efforts and seeds.

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
    fits: list[tuple[Problem, str, float | None, int | None]] = [
        (problem, m.name, None, None) for problem, those in able for m in those if not m.effort
    ]
    for seed, effort, (problem, those) in product(seeds, efforts, able):
        # A drawn split has its draws for seeds: further seeds would repeat the first draw.
        if problem.draw is None or seed == seeds[0]:
            fits += [(problem, m.name, effort, seed) for m in those if m.effort]
    cells = [
        (
            p,
            Cell(
                p.dataset,
                p.split,
                name,
                effort,
                seed if p.draw is None else p.draw,
                p.draw is not None,
                methods[name].reads(p),
            ),
        )
        for p, name, effort, seed in fits
    ]
    names = [str(cell) for _, cell in cells]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise ValueError(
                f"only: {pattern!r} matches no cell; they are dataset/split/method/effort/seed, "
                f"like {names[0] if names else 'rfid/random/gp/any/any'}"
            )
    return [
        cell for cell in cells if not only or any(fnmatchcase(str(cell[1]), part) for part in only)
    ]


def plan_jobs(settings: Mapping[str, Any], cells_dir: Path) -> list[Job]:
    """List the fits that conf/compare.yaml asks for, see `plan_cells`."""
    entries = settings["methods"]
    unlisted = {
        name: unlisted_contender
        for name, unlisted_contender in unlisted_contenders().items()
        if name not in entries
    }
    methods = unlisted | read_entries("methods", Contender, entries)
    for effort in settings["efforts"]:
        POSITIVE.check("efforts", effort)
    problems = load_every_problem(settings)
    cells = plan_cells(
        problems, methods, settings["efforts"], settings["seeds"], wanted_cells(settings)
    )
    datasets = {name: of or {} for name, of in settings["datasets"].items()}
    return [
        job_of_cell(
            cell,
            methods[cell.method],
            datasets[cell.dataset],
            problem,
            cells_dir,
            settings["reuse"],
        )
        for problem, cell in cells
    ]


def job_of_cell(
    cell: Cell,
    contender: Contender,
    settings: Mapping[str, Any],
    problem: Problem,
    cells_dir: Path,
    reuse: bool = False,
) -> Job:
    """Compose a cell's configuration and name its folder, `dataset/split/method/effort/seed`.

    Of a split that is drawn several times, models of the first draw are kept:
    queries are timed with those.
    """
    overrides = [*problem.chosen, *contender.overrides(cell.effort)]
    config = compose(settings, overrides, problem.draw, cell.seed)
    usual_s = FREE_S if cell.effort is None else EFFORT_S
    # Two seconds for loading and scoring a fold; time left and `limit_s` go by this.
    fit_s = 2.0 + (contender.train_s or usual_s) * (cell.effort or 1.0)
    return Job(
        cell,
        config,
        cells_dir / str(cell),
        problem.data,
        problem.folds,
        problem.content,
        expected_s=len(problem.folds.folds) * fit_s,
        keeps_models=not problem.draw,
        reuse=reuse,
    )
