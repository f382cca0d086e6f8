"""When a cell is done: its folder holds a summary of the same settings, files, data, split and program."""

from __future__ import annotations

import functools
import json
import logging
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from hashlib import file_digest, sha256
from importlib.metadata import distribution, packages_distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsparc.data.assemble import content_hash, identity_hash
from gsparc.data.errors import DataError, list_first
from gsparc.data.files import SUMMARY, set_aside, write_whole
from gsparc.data.instantiate import iterate_targets
from gsparc.data.schema import Measurements
from gsparc.evaluation.results import read_summary
from gsparc.models.fitting import LAST, dotted_settings

log = logging.getLogger(__name__)

RECORD = "job.json"  # in a cell's folder: its state, when it began, and whether it has ended
FAILURE = "failure.txt"  # why it has failed
WHERE = ("engine", "workers", "ray", "logger", "reuse")  # of where, or whether, a cell is done
OF_DATA = ("dataset.root", "dataset.file", "split.path")  # paths that stand for what was read from them
WHOLE = "gsparc.data.datasets.own.Own"  # reads no file but those that its settings name
PARTS = ("fold*/**/*.ckpt", "station*/*.ckpt", "unheard/*.ckpt")  # finished or not
PROGRAM = (".py", ".cpp", ".cu", ".h", ".hpp", ".cuh", ".so")
UNREAD = (".pyc", ".md", ".rst", ".log")  # by no plugin
OURS = ("gsparc", "ops", "callbacks", "conf", "hydra_plugins")  # folders of gsparc's checkout
STRING = r"""(?:\"{3}(?:\\.|[^\\])*?\"{3}|'{3}(?:\\.|[^\\])*?'{3}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')"""
REMARK = re.compile(rf"({STRING})|[ \t]*#[^\n]*|\n\s*(?=\n)", re.DOTALL)  # or an empty line
# After the head of a definition, or its last line: text after other colons is read by a program.
HEAD = r"(?m:^)[ \t]*(?:async def|def|class|\))[^\n]*:\n\s+"
DOCSTRING = re.compile(rf'({HEAD}|\A\s*)r?"{{3}}(?:\\.|[^\\])*?"{{3}}|({STRING})', re.DOTALL)
LIBRARIES = {"lightning", "torch"}  # named by every configuration; their versions stand in each summary


@dataclass(frozen=True)
class State:
    """What a result depends on.

    Attributes:
        settings: resolved, by dotted name.
        files: SHA-256 of the files that settings name, by these; those of the data are in `data`.
        data: SHA-256 of the measurements, whatever files they were read from; "" without any.
        split: SHA-256 of the folds.
        program: see `program_hash`.
    """

    settings: dict[str, Any]
    files: dict[str, str]
    data: str
    split: str
    program: str

    @classmethod
    def from_config(cls, config: DictConfig, data: str = "", split: str = "") -> State:
        """Return the state of a resolved configuration, of hashes of measurements and of their split."""
        kept = OmegaConf.masked_copy(config, [str(name) for name in config if name not in WHERE])
        whole: Any = OmegaConf.to_container(kept, resolve=True)  # what is missing is `???`
        named = {name: value for name, value in dotted_settings(whole) if not (data and name in OF_DATA)}
        files = {name: value for name, value in named.items() if isinstance(value, str)}
        found = {name: _content_of(value) for name, value in files.items() if os.path.isfile(value)}
        if os.path.isdir(root := files.get("dataset.root", "")):
            inside = [str(file.relative_to(root)) for file in Path(root).rglob("*")]
            found["dataset.root"] = _of_files(Path(root), inside)
        return cls(json.loads(json.dumps(named, default=str)), found, data, split, program_hash(whole))

    @classmethod
    def unread(cls, config: DictConfig) -> State | None:
        """Return the state by the bytes of its files, no data read; None where other files may be read."""
        state = cls.from_config(config)
        alone = state.settings.get("dataset._target_") == WHOLE and "dataset.file" in state.files
        return state if alone or "dataset.root" in state.files else None

    def same(self, record: Mapping[str, Any], reuse: bool = False) -> bool:
        """Return whether a record is of this state; `reuse`: whatever the program was."""
        names = set(asdict(self)) - ({"program"} if reuse else set())
        return all(record.get(name) == getattr(self, name) for name in names)

    def changes(self, record: Mapping[str, Any]) -> list[str]:
        """Return in what a record is of another state: `settings.effort`, `program` and its newer files."""
        own = asdict(self)
        now, before = (dict(dotted_settings({name: of.get(name) for name in own})) for of in (own, record))
        names = [name for name in before | now if before.get(name) != now.get(name)]
        return names + (_edited_since(record.get("began", math.inf)) if "program" in names else [])


def measurements_hash(data: Measurements) -> str:
    """Return the SHA-256 of all that a method can learn from, of every file that was read."""
    arrays = {name: value for name, value in vars(data).items() if isinstance(value, np.ndarray)}
    arrays |= {f"release {i}": rows for i, rows in enumerate(data.release_split or ())}
    whole = (identity_hash(data), content_hash(arrays), data.provenance.get("scene"))
    return sha256(repr(whole).encode()).hexdigest()


def read_finished(folder: Path, state: State, reuse: bool = False) -> dict[str, Any] | None:
    """Return the summary of a cell that is done; None where it is not.

    Args:
        folder: of the cell.
        state: of what is asked for, with its data or `State.unread`.
        reuse: whether a result of another program counts, too; its `program` and `git` say of which.
    """
    record = read_summary(folder / RECORD)
    if record is None or not record.get("ended"):
        return None
    same = state.same(record, reuse) or state.same(record.get("unread") or {}, reuse)
    return read_summary(folder / SUMMARY) if same else None


def run_once(
    folder: Path, state: State, work: Callable[[str | None], object], *, reuse: bool = False,
    again: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return the summary of a cell, which is done now where it is not done.

    Args:
        folder: the cell's own, held by the caller.
        state: of the cell.
        work: does it, and writes the summary; is given what `recorded` yields.
        reuse: see `read_finished`.
        again: one that is done is done anew.

    Raises:
        DataError: the work has left no summary.
    """
    facts = None if again else read_finished(folder, state, reuse)
    if facts is not None:
        log.info("%s: already done", folder)
        return facts
    with recorded(folder, state) as left:
        work(left)
    facts = read_summary(folder / SUMMARY)
    if facts is None:
        raise DataError(f"{folder / SUMMARY}: missing after the run; was it removed meanwhile?")
    return facts


@contextmanager
def recorded(folder: Path, state: State, unread: State | None = None) -> Iterator[str | None]:
    """Record when a cell begins, and that it has ended where nothing is raised.

    Args:
        folder: the cell's own, held by the caller.
        state: of the cell.
        unread: the same state, by which it is found done before its data are read.

    Yields:
        The checkpoint, or folder, of the same state that an interrupted try has left; None to begin anew.
    """
    record = read_summary(folder / RECORD)
    left = None
    if record is None or record.get("ended") or not state.same(record):
        if record is not None and not state.same(record):
            log.info("%s: begun anew, as these changed: %s", folder, list_first(state.changes(record)))
        set_aside(folder, SUMMARY)  # before the record: of two states one would take the other's for its own
        record = {**asdict(state), "unread": unread and asdict(unread), "began": time.time(), "ended": False}
        write_whole(folder / RECORD, json.dumps(record, indent=1))
    else:
        left = _last_state(folder, record["began"])
    (folder / FAILURE).unlink(missing_ok=True)  # of an earlier try
    yield left
    write_whole(folder / RECORD, json.dumps({**record, "ended": True}, indent=1))


def program_hash(settings: Any) -> str:
    """Return the hash of the text of gsparc and of every other package that settings name classes of."""
    named = {str(path).partition(".")[0] for path in iterate_targets(settings)}
    return _program(tuple(sorted({"gsparc", *named} - LIBRARIES)))


@functools.cache  # of a process, which runs what it has read
def _program(packages: tuple[str, ...]) -> str:
    digest = sha256()
    for package in packages:
        digest.update(f"{package} {package_hash(package)};".encode())
    return digest.hexdigest()[:12]


def package_hash(package: str) -> str:
    """Return the hash of the program that a package is, see `program_files`.

    Changes of pages, tests, comments or docstrings alone change nothing.
    """
    return _of_files(*program_files(package))


def program_files(package: str) -> tuple[Path, list[str]]:
    """Return a folder and the files below it that are a package's program; of gsparc's its own folders'.

    Of a plugin it is all that was installed with it, or stands beside it in packages or alone: what it
    imports, and the tables and weights that it reads.
    """
    spec = find_spec(package)
    if spec is None or not (spec.origin or spec.submodule_search_locations):
        return Path(), []
    inside = spec.submodule_search_locations
    root = Path(spec.origin).parent if spec.origin else Path(next(iter(inside or ())))
    root = root if inside is None else root.parent
    if package == "gsparc":
        every = (file for part in OURS for file in (root / part).rglob("*"))
        return root, [str(file.relative_to(root)) for file in every if file.suffix in PROGRAM]
    if root.name in ("site-packages", "dist-packages"):
        names = packages_distributions().get(package, ())
        return root, [str(file) for name in names for file in distribution(name).files or ()]
    packages = {one.parent for one in root.glob("*/__init__.py")} | ({root / package} if inside else set())
    beside = {*root.iterdir(), *(file for one in packages for file in one.rglob("*"))}
    return root, [str(one.relative_to(root)) for one in beside if one.suffix not in UNREAD]


def strip_comments(text: str) -> str:
    """Return Python without comments and empty lines, and with empty docstrings.

    By strings and comments alone: parsing every file of gsparc would take seconds at the start of each run.

    >>> strip_comments("mark = '#'  # of a comment")
    "mark = '#'"
    """
    code = REMARK.sub(lambda one: one[1] or "", text)
    return DOCSTRING.sub(lambda one: one[2] or f'{one[1]}""', code)


def _edited_since(began: float) -> list[str]:
    """Files of gsparc's program that are newer [s since 1970]."""
    root, files = program_files("gsparc")
    return [one for one in files if (root / one).stat().st_mtime > began]


def _of_files(root: Path, files: Iterable[str]) -> str:
    digest = sha256()
    for name in sorted(files):
        if (root / name).is_file():
            digest.update(f"{name} {_content_of(root / name)};".encode())
    return digest.hexdigest()


def _content_of(file: str | Path) -> str:
    """The hash of a file, of Python of what it does."""
    if Path(file).suffix == ".py":
        text = Path(file).read_text(encoding="utf-8", errors="replace")
        return sha256(strip_comments(text).encode()).hexdigest()
    with open(file, "rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


def _last_state(folder: Path, began: float) -> str | None:
    """The last checkpoint of this cell, not of one of another state before, or the folder of one of many
    parts; None: it begins anew."""

    def own(path: Path) -> bool:
        return path.exists() and path.stat().st_mtime >= began

    for name in LAST:
        if own(folder / name):
            return str(folder / name)
    return str(folder) if any(own(path) for pattern in PARTS for path in folder.glob(pattern)) else None
