"""`gsparc compare`: methods x datasets x splits under equal budgets, one table, one figure."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.markdown import Markdown

from gsparc.commands.compare import draws_figure, figure, table
from gsparc.commands.compare.cells import Budget, contenders, plan, plugged
from gsparc.commands.compare.fitting import (
    Filled,
    Prepared,
    fill,
    prepare,
)
from gsparc.commands.compare.latency import Latency, latencies
from gsparc.commands.compare.overview import overview
from gsparc.commands.compare.problem import Problem, load_problems, split_choices, stored_problems
from gsparc.commands.output import columns, run_directory, show
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.files import each_once, no_room, platform_cache, whole_file
from gsparc.evaluation.console import one_line
from gsparc.evaluation.summary import provenance, write_samples, write_summary

log = logging.getLogger(__name__)


def task(config: DictConfig) -> list[table.Row]:
    """Fill the cells that are asked for and not there yet, time all methods, and report."""
    RunSettings.of(config)
    run_dir = run_directory()
    settings = plain(config)
    methods = plugged() | contenders(settings["methods"])
    folder = settings["cells"]
    kept = Path(os.path.expanduser(folder)) if folder else platform_cache() / "comparison"
    problems = _problems(settings, kept)
    budgets = [
        Budget(float(b["seconds"]), tuple(map(int, b["seeds"])), tuple(b.get("splits") or ()))
        for b in settings["budgets"]
    ]
    prepared = [
        prepare(cell, methods[cell.method], settings["datasets"][cell.dataset] or {}, problem, kept)
        for problem, cell in plan(problems, methods, budgets, settings["only"])
    ]
    limit_s = None if settings["max_hours"] is None else float(settings["max_hours"]) * 3600
    several = HydraConfig.get().mode == RunMode.MULTIRUN
    failed = Failed(run_dir.parent) if several else None
    filled = fill_all(prepared, bool(settings["train"]), limit_s, failed)
    if settings["worker"]:
        log.info("every cell is filled or has failed; the report is worker 0's")
        return []
    if not filled:
        raise ValueError("no cell is filled: nothing to report (train=true fills them)")
    by_name = {(r.dataset, r.split): r for r in reversed(problems)}  # the first draw of each
    timed = _timed(filled, by_name, kept, bool(settings["latency"]))
    return report(filled, timed, str(settings["ours"]), run_dir)


def _problems(settings: Mapping[str, Any], kept: Path) -> list[Problem]:
    """Every dataset under every split that is meant for it, first draws first: the best-known come first.

    Without its path a dataset is there as far as results were kept, for the table alone.
    """
    wanted = [str(pattern) for pattern in settings["only"]]
    splits = split_choices(settings["splits"])
    problems: list[Problem] = []
    absent: dict[str, list[str]] = {"here as far as results were kept": [], "left out": []}
    paths = {
        name: [path for key, path in (of or {}).items() if key in ("root", "file")]
        for name, of in settings["datasets"].items()
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
        stored = stored_problems(kept, name, meant)
        problems += stored
        absent["here as far as results were kept" if stored else "left out"].append(name)
    for how, names in absent.items():
        if names:
            log.warning("%s %s: say datasets.NAME.root=DIR or .file=FILE", ", ".join(names), how)
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


class Failed:
    """Cells that processes of one multirun could not fill; those of an earlier multirun are tried again.

    Args:
        sweep: the multirun's folder.
    """

    def __init__(self, sweep: Path) -> None:
        self.folder, self.start = sweep / "failed", sweep / "multirun.yaml"  # which Hydra writes at the start

    def has(self, name: str) -> bool:
        """Whether a cell failed since the start."""
        file = self.folder / name
        if not file.exists():
            return False
        return not self.start.exists() or file.stat().st_mtime_ns >= self.start.stat().st_mtime_ns

    def add(self, name: str, why: str) -> None:
        """Say that a cell failed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_text(why + "\n", encoding="utf-8")


def fill_all(
    prepared: Sequence[Prepared],
    train: bool = True,
    limit_s: float | None = None,
    failed: Failed | None = None,
) -> list[Filled]:
    """Find or fill one cell after another, saying how far it is and how long it will take.

    A cell that cannot be filled is said and left out; the others go on. One that is not tried keeps what was
    measured with earlier program text. Processes that fill the same cells share them.

    Args:
        prepared: the most wanted first.
        train: whether missing cells are filled.
        limit_s: no cell is started that would end later [s].
        failed: where processes tell each other of cells that cannot be filled.
    """
    missing = [one for one in prepared if one.found() is None]
    log.info("%d cells, %d of them are there", len(prepared), len(prepared) - len(missing))
    started = time.monotonic()
    broken, late = set[str](), set[str]()  # cells

    def cannot(one: Prepared) -> bool:
        return str(one.cell) in broken or (failed is not None and failed.has(one.folder.name))

    def done(one: Prepared) -> bool:
        return one.found() is not None or str(one.cell) in late or cannot(one)

    def work(one: Prepared) -> None:
        if limit_s is not None and time.monotonic() - started + one.expected_s > limit_s:
            log.warning("max_hours: %s is not started", one.cell)
            late.add(str(one.cell))
            return
        left = sum(other.expected_s for other in missing if not done(other))
        number = prepared.index(one) + 1
        log.info("[%d/%d] %s ... about %.0f min left", number, len(prepared), one.cell, left / 60)
        try:
            _log_filled(fill(one))
        except KeyboardInterrupt:
            kept = "interrupted; finished cells are kept: the same command goes on with the others"
            raise KeyboardInterrupt(kept) from None
        except Exception as error:  # any error of a plugin: the other methods' table comes nevertheless
            if no_room(error):  # the others would be trained in vain
                raise
            unforeseen = not isinstance(error, ValueError | RuntimeError)  # says where it is
            log.warning("%s cannot be filled: %s", one.cell, one_line(error), exc_info=unforeseen)
            broken.add(str(one.cell))
            if failed is not None:
                failed.add(one.folder.name, one_line(error))

    if train:
        here = [one for one in missing if one.problem.data is not None]
        each_once(here, lambda one: one.lock, done, work)
    found = [one.found() or (None if cannot(one) else one.found_earlier()) for one in prepared]
    return [one for one in found if one is not None]


def _log_filled(found: Filled) -> None:
    scored = found.scored()
    score = f"{table.score_db(found.facts['dataset/kind'], found.facts):.2f} dB" if scored else "-"
    log.info("%s: %s after %.1f s", found.cell, score, found.facts["time/train_s"])


def _timed(
    filled: Sequence[Filled], problems: Mapping[tuple[str, str], Problem], kept: Path, measure: bool
) -> dict[str, dict[str, Latency]]:
    """Latencies by dataset and method: measured now on the first split that is there, or as kept."""
    found: dict[str, dict[str, Latency]] = {}
    for dataset in dict.fromkeys(one.cell.dataset for one in filled):
        here = [one for one in filled if one.cell.dataset == dataset]
        split, file = here[0].cell.split, kept / f"latency-{dataset}.json"
        first = [one for one in here if one.cell.split == split]
        present = [one for one in first if one.checkpoint.exists()]
        absent = {o.cell.method for o in first} - {o.cell.method for o in present}
        stored = json.loads(file.read_text()) if file.exists() else {}
        if measure and absent and stored:
            log.warning(
                "%s: timings are kept ones; models of %s are not here (cells=EMPTY_FOLDER trains all)",
                dataset, ", ".join(sorted(absent)),
            )  # fmt: skip
        elif measure and present and problems[dataset, split].data is not None:
            log.info("%s: timing single queries of every method in turns", dataset)
            found[dataset] = latencies(present, problems[dataset, split])
            rows = {name: asdict(one) for name, one in found[dataset].items()}
            with whole_file(file) as partial:  # another comparison may read it
                partial.write_text(json.dumps(rows, indent=2), encoding="utf-8")
            continue
        found[dataset] = {name: Latency(**values) for name, values in stored.items()}
    return found


def report(
    filled: Sequence[Filled], timed: Mapping[str, Mapping[str, Latency]], ours: str, run_dir: Path
) -> list[table.Row]:
    """Write `compare.csv`, `cells.csv`, `compare.md`, `summary.json` and pictures, and show the page.

    Splits that are drawn several times have a picture per dataset, all others are panels of `compare.png`.
    """
    rows = table.rows(filled, timed)
    blocks = table.blocks(rows)
    unscored = {one.cell.method for one in filled if not one.scored()}
    only_timed = {d: {n: t for n, t in here.items() if n in unscored} for d, here in timed.items()}
    drawn = [row for row in rows if row.draws]
    by_set = [
        [row for row in drawn if row.dataset == name] for name in dict.fromkeys(r.dataset for r in drawn)
    ]
    page = "\n\n".join([*map(overview, by_set), table.markdown(blocks, ours, only_timed)])
    write_samples(run_dir / "compare.csv", columns(rows, table.Row))
    write_samples(run_dir / "cells.csv", columns(table.results(filled), table.Result))
    (run_dir / "compare.md").write_text(page, encoding="utf-8")
    for one in by_set:
        draws_figure.draw(one, run_dir / f"{one[0].dataset}.png")
    if len(drawn) < len(rows):
        figure.draw([row for row in rows if not row.draws], run_dir / "compare.png", ours)
    facts: dict[str, Any] = {"cells": len(filled), **provenance()}
    for block in blocks:
        stem = f"{block.dataset}/{block.split}/{'any' if block.budget_s is None else f'{block.budget_s:g}'}"
        facts[f"{stem}/first"] = block.rows[0].method
        for row in block.rows:
            own = {"score_db": row.score_db, "train_s": row.train_s, "query_ms_p50": row.query_ms}
            facts |= {f"{stem}/{row.method}/{name}": value for name, value in own.items()}
    write_summary(run_dir / "summary.json", facts)
    show(run_dir, Markdown(page))
    return rows
