"""What every command has: settings, a folder that it writes to, and what it says at its end."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, wraps
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import RenderableType
from threadpoolctl import threadpool_limits

from gsparc.base import executor
from gsparc.base.executor import Engine
from gsparc.base.files import SUMMARY, write_samples
from gsparc.base.instantiate import suggest_or_list
from gsparc.base.limits import (
    POSITIVE,
    Checked,
    Limit,
    SettingError,
    check_arguments,
    choice,
    or_null,
    setting,
    whole,
)
from gsparc.data.splits import Split
from gsparc.evaluation.by_station import worst_stations
from gsparc.evaluation.console import last_warnings, note_said, open_console
from gsparc.evaluation.console import to_dict as to_dict
from gsparc.evaluation.summary import (
    provenance,
    remarks,
    results_table,
    write_summary,
)
from gsparc.evaluation.table import Table
from gsparc.models.registry import all_methods
from gsparc.prediction.timing import machine_facts
from gsparc.training.effort import refuse_seconds


@dataclass(frozen=True)
class RunSettings(Checked):
    """Settings of a run as a whole; a command has those of them that its configuration names.

    Attributes:
        seed: of whatever is random.
        threads: CPU threads of torch; None takes what it finds. NumPy's factorisations use one.
        eval_on: rows that are scored.
        baselines: names of methods; None: all plain ones that serve the data.
        effort: that all counts of a fit are multiplied by.
        stations: `auto`, `each` or `together`.
        draws: trials of a promise.
    """

    seed: int = setting(0, whole(0, 2**32 - 1))
    threads: int | None = setting(None, or_null(whole(1)))
    eval_on: str = setting("test", choice("train", "val", "test"))
    baselines: tuple[str, ...] | None = ()
    effort: float = setting(1.0, POSITIVE)
    stations: str = setting("auto", choice("auto", "each", "together"))
    draws: int = setting(1, whole(1))

    @classmethod
    def from_config(cls, config: DictConfig) -> RunSettings:
        """Check what can be checked before anything is read, and set the number of threads.

        Raises:
            ValueError: a setting that cannot be, named as it is in the configuration.
        """
        values = OmegaConf.to_container(config, resolve=True)
        assert isinstance(values, dict)
        refuse_seconds(dict(_leaves(values)))
        arguments: dict[str, Any] = {
            f.name: values[f.name] for f in fields(cls) if f.name in values
        }
        if "model" not in values:  # names of stations to ask, not how they are learned
            arguments.pop("stations", None)
        settings = cls(**{**arguments, "baselines": _methods(arguments.get("baselines", []))})
        trainer = values.get("trainer") or {}
        clip = trainer.get("gradient_clip_val")
        or_null(POSITIVE).check("trainer.gradient_clip_val", clip)  # Lightning takes any number
        # Starts in closed form and refits learn from all rows
        if few := trainer.get("overfit_batches"):
            fault = (
                f"trainer.overfit_batches={few}: not supported; split.train_count=32 learns "
                "from few rows"
            )
            raise SettingError(f"{fault}, which eval_on=train then scores")
        accelerator = trainer.get("accelerator", "auto")
        kinds = ["auto", "gpu", *_accelerators()] if trainer else [accelerator]
        if accelerator not in kinds:  # Lightning says so, but not where a model takes no steps
            raise SettingError(f"trainer.accelerator={accelerator!r}: one of {', '.join(kinds)}")
        if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
            raise SettingError(
                f"trainer.accelerator={accelerator}: there is no GPU here; say trainer=cpu"
            )
        for name, node in (config.get("callbacks") or {}).items():
            if node is not None and not isinstance(node, Mapping):
                raise SettingError(
                    f"callbacks.{name}={node}: is a group of settings; null leaves it out"
                )
            instantiate(node)  # checks itself
        for key, value in _leaves(values):
            # YAML's .inf and .nan are floats, and no comparison with NaN refuses it.
            if isinstance(value, float):
                Limit("a finite number", math.isfinite).check(key, value)
        if settings.threads is not None:
            torch.set_num_threads(settings.threads)
        address = (values.get("ray") or {}).get("address")
        executor.use_engine(Engine(values.get("engine", "process"), values.get("workers"), address))
        # NumPy's: two threads beside other work took 10 to 400 times as long as one.
        threadpool_limits(1, "blas")
        return settings


def _accelerators() -> list[str]:
    # seconds; not every command trains
    from lightning.pytorch.accelerators import AcceleratorRegistry

    return sorted(AcceleratorRegistry.available_accelerators())


def _methods(names: Any) -> tuple[str, ...] | None:
    if names is None:
        return None
    methods = all_methods()
    if isinstance(names, list) and all(name in methods for name in names):
        return tuple(names)
    wrong = (
        next((b for b in names if b not in methods), names) if isinstance(names, list) else names
    )
    hint = suggest_or_list(str(wrong), methods)
    raise SettingError(f"baselines={names}: a list of methods is needed, {wrong!r} is none{hint}")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(node, Mapping):
        yield prefix, node
        return
    for key, value in node.items():
        yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))


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
                note_said(Path(path).parent)
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
