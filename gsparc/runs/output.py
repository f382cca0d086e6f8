"""Where a command writes, and what it says at its end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, wraps
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import RenderableType

from gsparc.base.files import SUMMARY, write_samples
from gsparc.base.limits import Limit, check_arguments
from gsparc.data.splits import Split
from gsparc.evaluation.by_station import worst_stations
from gsparc.evaluation.console import last_warnings, mark_logged_warnings_shown, open_console
from gsparc.evaluation.provenance import provenance
from gsparc.evaluation.summary import remarks, results_table, write_summary
from gsparc.evaluation.table import Table
from gsparc.prediction.timing import machine_facts
from gsparc.runs.settings import RunSettings, to_dict

Task = Callable[..., Any]  # of a configuration, and of a folder other than Hydra's


def run_directory() -> Path:
    """Return where the running command writes."""
    return Path(HydraConfig.get().runtime.output_dir)


@dataclass(frozen=True)
class CommandCall:
    """What a command is called with.

    Attributes:
        config: its settings.
        folder: where it writes.
    """

    config: DictConfig
    folder: Path

    @cached_property
    def given(self) -> dict[str, Any]:
        """Return the settings as plain containers; one that is missing is an error."""
        return to_dict(self.config)

    @property
    def paths(self) -> list[str]:
        """Return the files of `ckpt`, one or several."""
        ckpt = self.given["ckpt"]
        return [ckpt] if isinstance(ckpt, str) else ckpt


@dataclass(frozen=True)
class Result:
    """What a command ends with.

    Attributes:
        facts: of `summary.json`.
        tables, lines: that are shown.
        before: where everything was written is said after this.
        columns: of CSV files, by their names.
    """

    facts: dict[str, Any]
    tables: Sequence[RenderableType] = ()
    lines: Iterable[str] = ()
    before: str = ""
    columns: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def show(self, folder: Path) -> dict[str, Any]:
        """Write it with the program and the machine, and show it; returns the facts.

        Of the machine, what they say of it stands.
        """
        for name, columns in self.columns.items():
            write_samples(folder / name, columns)
        whole = {**machine_facts(), **self.facts, **provenance()}
        write_summary(folder / SUMMARY, whole)
        show_result(folder, *self.tables, lines=self.lines, before=self.before)
        return whole


def command(**limits: Limit) -> Callable[[Callable[[CommandCall], Any]], Task]:
    """Make a function of a `CommandCall` the task of a command.

    Settings are checked before it, its `Result` is shown after it; the task returns the facts.

    Args:
        **limits: of settings of its own.

    Raises:
        ValueError: a setting that cannot be.
    """

    def decorate(work: Callable[[CommandCall], Any]) -> Task:
        @wraps(work)
        def task(config: DictConfig, folder: Path | None = None) -> Any:
            RunSettings.from_config(config)
            check_arguments(config, **limits)
            call = CommandCall(config, folder or run_directory())
            # What a run warned of is not said again by whoever asks its model.
            for path in call.paths if config.get("ckpt") else ():
                mark_logged_warnings_shown(Path(path).parent)
            result = work(call)
            return result.show(call.folder) if isinstance(result, Result) else result

        return task

    return decorate


def in_multirun() -> bool:
    """Tell whether the running command is a job of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def show_result(
    run_dir: Path, *tables: RenderableType, lines: Iterable[str] = (), before: str = ""
) -> None:
    """Show what a command ends with: tables, sentences,
    and `before` with where everything was written.
    """
    console = open_console()
    console.record = True
    for table in tables:
        console.print(table)
    # Hydra opens a log for every job; one without a line is not worth a word.
    logs = [path.name for path in run_dir.glob("*.log") if path.stat().st_size]
    log = "".join(f"; full log: {name}" for name in logs)
    for line in (*last_warnings(*logs[:1]), *lines, f"{before}written to {run_dir}{log}"):
        console.print(line, highlight=False)
    files = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.FileHandler)
    ]
    text = console.export_text().rstrip()
    for file in files:  # to the log's file alone: the console has it
        file.handle(
            logging.LogRecord(__name__, logging.INFO, __file__, 0, f"result:\n{text}", None, None)
        )


def show_training(
    config: DictConfig,
    run_dir: Path,
    facts: Mapping[str, Any],
    split: Split,
    stations: Mapping[str, Any],
) -> None:
    """Show the table of a training, the worst of its `stations`, and remarks."""
    scored = (config.eval_on, "val")  # the second where `split=none` left no test rows
    tested = [rows for rows in scored if any(key.startswith(f"{rows}/") for key in facts)]
    eval_on = tested[0] if tested else config.eval_on
    drawn = config.split.get("seed") is not None and not split.of_release
    draw = f" (split.seed={config.split.seed})" if drawn else ""
    title = f"{facts['dataset/name']}, split {split.title}{draw}, {eval_on}, seed {config.seed}"
    tables = tables_of(facts, title, eval_on, stations) if tested else []
    show_result(run_dir, *tables, lines=remarks(facts, eval_on))


def tables_of(
    facts: Mapping[str, Any], title: str, eval_on: str, stations: Mapping[str, Any]
) -> list[Table]:
    """Return the table of a method beside others, and that of the worst of its `stations`,
    if any.
    """
    label, later = facts["model/label"], not facts.get("split/train")
    return [results_table(facts, label, title, eval_on), *worst_stations(stations, label, later)]
