"""What commands read and say: plain settings, a console, its log,
errors in one line with what to do.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from hydra import errors
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from rich.console import Console

from gsparc.base.errors import DataError, Severe, warning_kind
from gsparc.base.instantiate import GROUPS, cause_of, plugin_node, plugins, suggest_or_list

FULL_ERROR = "HYDRA_FULL_ERROR"
CONFIGS = "pkg://gsparc.conf"
WIDE = 120
MOST_WARNINGS = 10  # lines of a run on the console, of which severe ones are said twice
SAID = "[WARNING] - "  # in a line of a log's file
READERS = "gsparc.datasets"  # loggers: one file may be read several times in a run
PATH = r"^\S*/\S*: "  # at its head


def open_console() -> Console:
    """Open a console without line breaks in sentences; tables as wide as the terminal,
    or `WIDE` in a log.

    Without markup: square brackets of a path or a title are no style.
    """
    terminal = Console(soft_wrap=True, markup=False)
    # A log has no width: 80 cut headings short
    has_width = terminal.is_terminal or "COLUMNS" in os.environ
    return terminal if has_width else Console(soft_wrap=True, markup=False, width=WIDE)


class ConsoleHandler(logging.StreamHandler):  # type: ignore[type-arg]
    """The log as the console shows it: messages alone, of each kind of warning the first,
    and of kinds a few.

    The log's file has every line, with time, level and module.

    Args:
        quiet: loggers, packages mostly, of which only warnings are shown.
        stream: where lines go; None: stdout.
    """

    # What was said of files, by any handler: jobs of a sweep have their own
    read: ClassVar[set[str]] = set()
    # Warnings that a run said whose model is asked now, without paths
    before: ClassVar[set[str]] = set()

    def __init__(self, quiet: Iterable[str] = (), stream: Any = None) -> None:
        super().__init__(stream or sys.stdout)
        self.quiet = tuple(f"{name}." for name in quiet)
        self.kinds: set[str] = set()  # of warnings that were shown
        self.shown, self.hidden = set[str](), set[str]()
        self.severe: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is shown; keeps warnings that are not."""
        message = record.getMessage()
        if record.levelno < logging.WARNING:
            text = re.sub(r"^\S*/", "", message) if record.name.startswith(READERS) else ""
            again = text in self.read
            self.read.update({text} - {""})
            return not again and not f"{record.name}.".startswith(self.quiet)
        kind, text = warning_kind(message), re.sub(PATH, "", message)
        severe = isinstance(record.args, tuple) and any(isinstance(a, Severe) for a in record.args)
        if record.levelno == logging.WARNING and text in self.before | self.shown:
            return False
        if severe:
            self.severe.append(f"this may change the figures above: {message}")
        # An error is always shown; what may change the figures before all the rest, and again.
        room = len(self.kinds) + len(self.severe) < MOST_WARNINGS
        if record.levelno > logging.WARNING or (kind not in self.kinds and room):
            self.kinds.add(kind)
            self.shown.add(text)
            return True
        self.hidden.add(text)
        return False

    def format(self, record: logging.LogRecord) -> str:
        """Return the message; of a warning or an error after its level."""
        level = "" if record.levelno < logging.WARNING else f"{record.levelname.lower()}: "
        return level + record.getMessage().strip().partition("\n")[0]


def last_warnings(file: str = "the log") -> list[str]:
    """Return a command's last lines on warnings: severe ones, and how many more its `file` has."""
    screens = [
        handler for handler in logging.getLogger().handlers if isinstance(handler, ConsoleHandler)
    ]
    severe = dict.fromkeys(text for screen in screens for text in screen.severe)
    more = sum(len(screen.hidden) for screen in screens)
    return [*severe, *([f"{more} more warnings in {file}"] if more else [])]


def mark_logged_warnings_shown(folder: Path) -> None:
    """Take what the log in a run's folder, or in one above its part's, warned of as said."""
    for file in (file for place in (folder, folder.parent) for file in place.glob("*.log")):
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
        said = (line.partition(SAID)[2] for line in lines)
        ConsoleHandler.before.update(re.sub(PATH, "", text) for text in said if text)


def to_dict(node: DictConfig) -> dict[str, Any]:
    """Return a group of settings as plain containers;
    a setting that is still missing is an error.
    """
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True)  # type: ignore[return-value]


def error_in_one_line(error: BaseException) -> str:
    """Return what went wrong and what to do, on one line;
    misspelt keys and choices get the nearest name.
    """
    if (
        isinstance(error, errors.MissingConfigException)
        and error.missing_cfg_file
        and error.options
    ):
        group, _, choice = str(error.missing_cfg_file).partition("/")
        if group == "hydra":  # hydra/sweeper/optuna
            part, _, choice = choice.rpartition("/")
            there = ", ".join(error.options)
            return (
                f"{group}/{part}={choice}: no such choice; there are {there} (is its plugin "
                "installed?)"
            )
        if group in GROUPS and (path := plugins(group).get(choice)):
            try:
                plugin_node(group, choice)
            except DataError as failed:
                return f"{group}={choice}: its plugin ({path}) cannot be imported: {failed}"
        hint = suggest_or_list(choice, list_choices(group) or list(error.options))
        return f"{group}={choice}: no such choice{hint}"
    if isinstance(error, errors.OverrideParseException):
        nested = re.search(r"[\[{,:]\s*[\w.]+=", str(error.override))
        inside = f'; inside brackets quote it: "{nested[0].strip("[{,: ")}..."' if nested else ""
        form = f"write KEY=VALUE, KEY=[a,b], or \"KEY='any text'\"{inside}"
        return f"{error.override}: not understood; {form}"
    if isinstance(error, errors.ConfigCompositionException) and isinstance(
        error.__cause__, OmegaConfBaseException
    ):
        return _override(error, error.__cause__)
    if isinstance(error, MissingMandatoryValue):
        key = str(error.full_key or str(error).rpartition(" ")[2])
        return f"{key} is not set; give {key}=..."
    if isinstance(error, errors.InstantiationException) and error.__cause__ is not None:
        return error_in_one_line(cause_of(error))
    if isinstance(error, errors.HydraException):
        return " ".join(str(error).split())
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return f"{error.full_key}: {_first(error)}"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    text = _first(error)
    # Errors of use are ValueErrors and their like; for a bug the type is shown too.
    expected = isinstance(error, (ValueError, OSError, RuntimeError))
    # Lightning's, of the Trainer's options
    expected |= type(error).__name__ == "MisconfigurationException"
    return (
        text
        if expected and text
        else (f"{type(error).__name__}: {text} ({FULL_ERROR}=1 shows where)")
    )


def config_folder() -> Path:
    """Return where the configurations are."""
    return Path(import_module(CONFIGS.removeprefix("pkg://")).__path__[0])


def list_choices(group: str) -> list[str]:
    """List every choice of a config group, those in its folders as `folder/choice`,
    and those of plugins.
    """
    folder = config_folder() / group
    names = {str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.yaml")}
    stored = ConfigStore.instance().repo.get(group, {})
    return sorted(names.union(name.removesuffix(".yaml") for name in stored))


def _override(error: Exception, cause: OmegaConfBaseException) -> str:
    named = re.search(r"override '([^']+)'", str(error))
    full = str(cause.full_key or (named.group(1) if named else ""))
    if not full or cause.parent_node is None or "not" not in str(cause):
        return f"{_first(error)} {_first(cause)}"
    names = [str(k) for k in cause.parent_node if str(k) != "hydra"]
    prefix, dot, key = full.rpartition(".")
    groups = (
        cause.parent_node.items_ex(resolve=False) if OmegaConf.is_dict(cause.parent_node) else ()
    )
    for group in [k for k, node in groups if OmegaConf.is_dict(node) and key in node]:
        # Such as a column's quantity, which is no setting of the dataset.
        return f"{full}: no such setting; did you mean '{prefix}{dot}{group}.{key}'?"
    hint = suggest_or_list(key, names).replace("did you mean '", f"did you mean '{prefix}{dot}")
    hint = "; say hydra/launcher=joblib, too, or ray" if prefix == "hydra.launcher" else hint
    return f"{full}: no such setting{hint}"


def _first(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else ""
