"""What a comparison is about: measurements, and which rows of them learn and test."""

from __future__ import annotations

import functools
import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from fnmatch import fnmatchcase
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import hydra
from omegaconf import DictConfig, OmegaConf

from gsparc.data.assemble import identity
from gsparc.data.load import load, split_for
from gsparc.data.public.fetch import found
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.console import plain
from gsparc.models.registry import complete
from gsparc.simulate.scenes.build import names_scene

log = logging.getLogger(__name__)

RESULT = "cell.json"
Entry = TypeVar("Entry")


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


@dataclass(frozen=True)
class Problem:
    """One dataset under one draw of a split; its measurements may be absent, then kept results say what they
    were.

    Attributes:
        dataset, split: names.
        kind: of the measurements.
        hashes: of the measurements alone, of the folds, and of the former with every fact of their site.
        draw: number of the split's draw; None where it is not drawn again.
        stations: whether there are several.
        scene: whether they name a scene that a ray tracer loads.
        chosen: overrides of train.yaml for dataset and split, but for the draw.
        data: measurements; None where they are not here.
        folds: which rows learn and which test.
    """

    dataset: str
    split: str
    kind: str
    hashes: tuple[str, str, str]
    draw: int | None = None
    stations: bool = False
    scene: bool = False
    chosen: tuple[str, ...] = ()
    data: Measurements | None = None
    folds: Split | None = None

    def present(self) -> tuple[Measurements, Split]:
        """Measurements and folds.

        Raises:
            ValueError: they are not here.
        """
        if self.data is None or self.folds is None:
            raise ValueError(f"{self.dataset}/{self.split}: the measurements are not here")
        return self.data, self.folds


def named(group: str, of: Callable[..., Entry], config: Mapping[str, Any]) -> dict[str, Entry]:
    """A group of named settings of conf/compare.yaml: `methods` or `splits`; an empty entry has defaults.

    Raises:
        ValueError: an entry with an unknown setting, or without one that is needed.
    """
    known, entries = [name for name in signature(of).parameters if name != "name"], {}
    for name, entry in config.items():
        own = {k: tuple(v) if isinstance(v, (list, tuple)) else v for k, v in dict(entry or {}).items()}
        if unknown := sorted(set(own) - set(known)):
            raise ValueError(f"{group}.{name}: unknown {unknown[0]!r}; there are {', '.join(known)}")
        try:
            entries[str(name)] = of(name=str(name), **own)
        except TypeError as error:
            raise ValueError(f"{group}.{name}: {str(error).partition('() ')[2]}") from None
    return entries


def load_problems(name: str, settings: Mapping[str, Any], splits: Sequence[SplitChoice]) -> list[Problem]:
    """Load what `conf/dataset` names, with the given settings, once for all draws of all splits."""
    data: Measurements | None = None
    problems = []
    for split in splits:
        chosen = (f"dataset={settings.get('dataset', name)}", *split.overrides)
        for draw in split.numbers:
            config = compose(settings, chosen, draw)
            data = load(plain(config.dataset)) if data is None else data
            folds = split_for(plain(config.split), data)
            hashes = (data.site.sha256, folds.sha256, identity(data))
            several = data.site.stations is not None and folds.name != "stations"
            known = names_scene(data.provenance)
            problems.append(
                Problem(name, split.name, data.site.scored, hashes, draw, several, known, chosen, data, folds)
            )
    return problems


def facts_of(result: Path) -> dict[str, Any] | None:
    """What a kept result says; None where there is none, or no whole one."""
    try:
        facts: dict[str, Any] = json.loads(result.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return facts


def stored_problems(cells_dir: Path, dataset: str, splits: Sequence[SplitChoice]) -> list[Problem]:
    """The problems of a dataset that most kept results are of, one per draw of a split."""
    problems = []
    for split in splits:
        files = sorted(cells_dir.glob(f"{dataset}-{split.name}-*/{RESULT}"))
        facts = [one for file in files if (one := facts_of(file)) is not None]
        for draw in split.numbers:
            known = Counter(
                (
                    f["dataset/kind"],
                    (f["dataset/sha256"], f["split/sha256"], f.get("dataset/identity", "")),  # once not kept
                    *(bool(f.get(f"problem/{of}")) for of in ("stations", "scene")),
                )
                for f in facts
                if draw is None or f["seed"] == draw
            )
            if known:
                kind, hashes, several, scene = known.most_common(1)[0][0]
                problems.append(Problem(dataset, split.name, kind, hashes, draw, several, scene))
    return problems


def compose(
    settings: Mapping[str, Any], overrides: Sequence[str], draw: int | None = None, seed: int | None = None
) -> DictConfig:
    """The configuration `train.py` would see.

    Args:
        settings: of its dataset; `dataset` is the choice itself, and left out.
        overrides: of train.yaml.
        draw: `split.seed`; None: as the split has it.
        seed: None: 0.
    """
    config = deepcopy(_composed(tuple(overrides)))
    own = {name: value for name, value in settings.items() if name != "dataset"}
    OmegaConf.update(config, "dataset", own, merge=True)
    OmegaConf.update(config, "seed", seed or 0)
    if draw is not None:
        OmegaConf.update(config, "split.seed", draw)
    return config


@functools.cache
def _composed(overrides: tuple[str, ...]) -> DictConfig:
    """Composing takes half a second, and draws differ in numbers only."""
    chosen = ["logger=none", "~callbacks.pictures", *overrides]
    config = hydra.compose("train", overrides=[*chosen, "hydra.run.dir=."])
    complete(config.model)
    return config


def problems_of(settings: Mapping[str, Any], cells_dir: Path) -> list[Problem]:
    """Every dataset under every split that is meant for it, first draws first: the best-known come first.

    Without its path a dataset is there as far as results were kept, for the table alone.
    """
    wanted = [str(pattern) for pattern in settings["only"]]
    splits = named("splits", SplitChoice, settings["splits"])
    problems: list[Problem] = []
    absent: dict[str, list[str]] = {"here as far as results were kept": [], "left out": []}
    paths = {
        name: [path or found(of.get("dataset", name)) for key, path in of.items() if key in ("root", "file")]
        for name, of in ((name, of or {}) for name, of in settings["datasets"].items())
    }
    here = {name: not of or any(of) for name, of in paths.items()}  # a plugin's dataset may need no path
    for name, own in settings["datasets"].items():
        meant = [
            split
            for split in splits.values()
            if (not split.datasets or name in split.datasets)
            and (not wanted or any(_may_match(p, name, split.name) for p in wanted))
        ]
        if here[name]:
            problems += load_problems(name, own, meant) if meant else []
            continue
        stored = stored_problems(cells_dir, name, meant)
        problems += stored
        absent["here as far as results were kept" if stored else "left out"].append(name)
    for how, names in absent.items():
        if names:
            log.warning(
                "%s %s: say datasets.NAME.root=DIR or .file=FILE, or gsparc data", ", ".join(names), how
            )
    order = list(splits)
    problems.sort(key=lambda problem: (problem.draw or 0, order.index(problem.split)))
    if not problems and not any(here.values()):
        raise ValueError("no dataset has a path; say datasets.rfid.root=DIR or datasets.newrf.file=FILE")
    if not problems:
        raise ValueError(f"only={settings['only']}: matches no dataset and split that are there")
    return problems


def _may_match(pattern: str, dataset: str, split: str) -> bool:
    """Whether a pattern of cells can match this problem, so that others need not be loaded."""
    for part, name in zip(pattern.split("/"), (dataset, split), strict=False):
        if "*" in part:  # it may stand for what follows, too
            return fnmatchcase(name, part.partition("*")[0] + "*")
        if not fnmatchcase(name, part):
            return False
    return True
