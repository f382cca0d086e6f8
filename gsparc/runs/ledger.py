"""The ledger of fits: one is done when its settings, data,
split and program are those of its record.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from hashlib import file_digest, sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsparc.base.errors import DataError, list_first
from gsparc.base.files import SUMMARY, set_aside, write_whole
from gsparc.data.assemble import content_hash, identity_hash
from gsparc.data.schema import Measurements
from gsparc.evaluation.provenance import provenance, run_git
from gsparc.evaluation.results import read_summary
from gsparc.models.checkpoint import MODEL
from gsparc.models.fitting import LAST, dotted_settings
from gsparc.tables.said_columns import columns_file_beside

log = logging.getLogger(__name__)

# In a fit's folder: its state and program, when it began, and whether it has ended
RECORD = "job.json"
FAILURE = "failure.txt"  # why it has failed
REFUSED = "not possible"  # in the error of an effect that the data do not allow
# Of where, or whether, a fit is done
WHERE = ("engine", "workers", "ray", "logger", "reuse", "ckpt_path")
OF_DATA = (  # paths that stand for what was read from them, or is written there where nothing is
    *("dataset.root", "dataset.file", "split.path"),
    "dataset.stand_in.root",
)
# Settings that are never paths: a folder may be called as a method is
WORDS = (".name", "._target_")
WRITERS = ("callbacks.", "trainer.")  # folders that these name are written to
WHOLE = "gsparc.datasets.own.Own"  # reads no file but those that its settings name
LEFT = (  # by a training: of another one, all of it would be read beside this one's
    *("summary.json", "split.json", "per_sample.csv", "by_station.csv", "render_ms.csv"),
    *("predictions.npz", "test.png", "found.png"),
    *(f"{fold}{name}" for fold in ("", "fold*/") for name in (MODEL, "learning_curve.csv")),
)
PARTS = ("fold*/**/*.ckpt", "station*/*.ckpt", "unheard/*.ckpt")  # finished or not
GSPARC, ROOT = "gsparc", Path(__file__).resolve().parents[1]
OURS = ("gsparc", "hydra_plugins", "__main__", "__mp_main__")  # modules that the edition tells of
INSTALLED = tuple(
    {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
)


@dataclass(frozen=True)
class FitInputs:
    """What a fit depends on besides the program: a fit of the same inputs is done.

    Attributes:
        settings: resolved, by dotted name, without those that say where data lie.
        files: SHA-256 of the files that settings name, by these.
        data: SHA-256 of the measurements, whatever files they were read from; "" before they are
            read.
        split: SHA-256 of the folds.
        unread: SHA-256 of the files that data and folds are read from; a state before they are read
            is known by these.
    """

    settings: dict[str, Any]
    files: dict[str, str]
    data: str = ""
    split: str = ""
    unread: dict[str, str] = field(default_factory=dict)

    @classmethod
    def from_config(cls, config: DictConfig, data: str = "", split: str = "") -> FitInputs:
        """Return the state of a resolved configuration,
        of hashes of measurements and of their split.
        """
        subset = OmegaConf.masked_copy(config, [str(name) for name in config if name not in WHERE])
        whole: Any = OmegaConf.to_container(subset, resolve=True)  # what is missing is `???`
        named = dict(dotted_settings(whole))
        where = {name: named.pop(name) for name in OF_DATA if name in named}
        about = columns_file_beside(str(where.get("dataset.file")))
        where |= {"dataset.file (columns)": str(about)} if about else {}
        settings = json.loads(json.dumps(named, default=str))
        return cls(settings, _hashes(named), data, split, {} if data else _hashes(where))

    @property
    def tells_data(self) -> bool:
        """Whether what is read is known: its content,
        or the bytes of all files that it is read from.
        """
        alone = self.settings.get("dataset._target_") == WHOLE and "dataset.file" in self.unread
        return bool(self.data) or alone or "dataset.root" in self.unread

    def changes(self, record: Mapping[str, Any], reuse: bool = False) -> list[str]:
        """Return in what a record is of another state: `settings.effort`, modules.

        `reuse`: whatever the program was.
        """
        names = ("settings", "files", *(("data", "split") if self.data else ("unread",)))
        now, before = ({name: of.get(name) or {} for name in names} for of in (vars(self), record))
        settings_now, settings_before = dict(dotted_settings(now)), dict(dotted_settings(before))
        differing = [
            name
            for name in settings_before | settings_now
            if settings_now.get(name) != settings_before.get(name)
        ]
        return differing if reuse else differing + edited(record)


def measurements_hash(data: Measurements) -> str:
    """Return the SHA-256 of all that a method can learn from, of every file that was read."""
    arrays = {name: value for name, value in vars(data).items() if isinstance(value, np.ndarray)}
    arrays |= {f"release {i}": rows for i, rows in enumerate(data.release_split or ())}
    whole = (identity_hash(data), content_hash(arrays), data.provenance.get("scene"))
    return sha256(repr(whole).encode()).hexdigest()


def read_finished(folder: Path, state: FitInputs, reuse: bool = False) -> dict[str, Any] | None:
    """Return the summary of a fit that is done; None where it is not.

    Args:
        folder: of the fit.
        state: of what is asked for; before data are read it answers where it `tells_data`.
        reuse: whether a result of another program counts, too; its `git` says of which.
    """
    record = read_summary(folder / RECORD)
    if (
        record is None
        or not record.get("ended")
        or not state.tells_data
        or state.changes(record, reuse)
    ):
        return None
    return read_summary(folder / SUMMARY)


def run_once(
    folder: Path,
    state: FitInputs,
    work: Callable[[str | None], object],
    *,
    reuse: bool = False,
    again: bool = False,
    resumes: bool = False,
) -> dict[str, Any]:
    """Return the summary of a fit, which is done now where it is not done.

    Args:
        folder: its own, held by the caller.
        state: of the fit.
        work: does it, and writes the summary; is given the checkpoint, or folder, of the same state
            that an interrupted try has left, None to begin anew.
        reuse: see `read_finished`.
        again: one that is done is done anew.
        resumes: whether the work goes on from a file that it was told, whatever changed since.

    Raises:
        DataError: the work has left no summary.
    """
    facts = None if again else read_finished(folder, state, reuse)
    if facts is not None:
        log.info("%s: already done", folder)
        return facts
    record, resume_path = read_summary(folder / RECORD), None
    changes = [] if record is None else state.changes(record)
    if record is None or record.get("ended") or changes:
        if record is not None and changes and not resumes:
            settings = state.changes(record, reuse=True)
            words = [*settings, "the program"] if changes != settings else settings
            log.info("%s: runs again, as these changed since it ran: %s", folder, list_first(words))
        # Before the record: of two states one would take the other's for its own
        set_aside(folder, SUMMARY)
        record = {**asdict(state), "began": time.time()}
    else:
        resume_path = _last_state(folder, record["began"])
    (folder / FAILURE).unlink(missing_ok=True)  # of an earlier try

    def write(ended: bool) -> None:
        whole = {**record, "program": program(), "ended": ended}
        write_whole(folder / RECORD, json.dumps(whole, indent=1))

    write(False)
    try:
        work(resume_path)
    except BaseException:
        with suppress(OSError):  # such as a full disk, which the error itself names
            write(False)  # with what was imported meanwhile
        raise
    write(True)
    facts = read_summary(folder / SUMMARY)
    if facts is None:
        raise DataError(f"{folder / SUMMARY}: missing after the run; was it removed meanwhile?")
    return facts


def set_earlier_aside(run_dir: Path, *begun_from: str | None) -> None:
    """Move files of an earlier run aside, except those that a training resumes or starts from."""
    paths = [Path(path).resolve() for path in begun_from if path]
    goes_on = any(run_dir.resolve() in (path, *path.parents) for path in paths)
    if set_aside(run_dir, *LEFT[: 1 if goes_on else None]):
        log.info("%s: files of an earlier run there were renamed to NAME.earlier", run_dir)


def edited(record: Mapping[str, Any]) -> list[str]:
    """Return which parts of a record's program are others now."""
    before = record.get("program")
    if not isinstance(before, Mapping):  # an older record has one hash of all
        return [GSPARC]
    return [name for name, content in before.items() if _content(name) != content]


def program() -> dict[str, str]:
    """Return gsparc's edition, and the content of modules that no environment installed,
    by their files.

    The edition is the commit of the source tree with a hash of what was edited since,
    else the version.
    """
    modules = [m for name, m in list(sys.modules.items()) if name.partition(".")[0] not in OURS]
    files = {os.path.abspath(getattr(module, "__file__", None) or os.curdir) for module in modules}
    others = sorted(
        file for file in files if os.path.isfile(file) and not file.startswith(INSTALLED)
    )
    return {name: _content(name) for name in (GSPARC, *others)}


def _content(name: str) -> str:
    """Of an entry of `program`; "" where it is gone."""
    if name == GSPARC:
        return _edition()
    return _hash_of(Path(name)) if os.path.isfile(name) else ""


@functools.cache  # of a process, which runs what it has read
def _edition() -> str:
    commit = provenance()["git"] or version("gsparc")
    edits = run_git(ROOT, "diff", "HEAD") if commit.endswith("-dirty") else ""
    return f"{commit} {sha256(edits.encode()).hexdigest()}" if edits else commit


def _joined(files: Iterable[Path], root: Path) -> str:
    hashes = {
        str(file.relative_to(root)): _hash_of(file) for file in sorted(files) if file.is_file()
    }
    return sha256(repr(hashes).encode()).hexdigest()


def _hashes(settings: Mapping[str, Any]) -> dict[str, str]:
    """Of those settings that name a file or folder, alone or in a list."""
    hashes = {
        name: _named(value)
        for name, value in settings.items()
        if not name.endswith(WORDS) and not (name.startswith(WRITERS) and os.path.isdir(str(value)))
    }
    return {name: content for name, content in hashes.items() if content}


def _named(value: Any) -> str:
    """The hash of the files that a setting's value names; empty: none."""
    if isinstance(value, Mapping | list | tuple):
        parts = [_named(part) for part in (value.values() if isinstance(value, Mapping) else value)]
        return sha256(repr(parts).encode()).hexdigest() if any(parts) else ""
    if not isinstance(value, str) or not value:
        return ""
    if os.path.isdir(value):
        return _joined(_files_under(value), Path(value))
    value = value.removeprefix("itm:")  # of `model.prior`, before the name of a terrain
    return _hash_of(Path(value)) if os.path.isfile(value) else ""


def _files_under(root: str) -> Iterator[Path]:
    """All files of a folder and of those that links in it lead to, each folder once;
    not those of fits.
    """
    seen = set[str]()
    for folder, inner, names in os.walk(root, followlinks=True):
        if os.path.realpath(folder) in seen or (RECORD in names and folder != root):
            inner.clear()
            continue
        seen.add(os.path.realpath(folder))
        yield from (Path(folder, name) for name in names)


def _hash_of(file: Path) -> str:
    with open(file, "rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


def _last_state(folder: Path, began: float) -> str | None:
    """The last checkpoint of this fit, not of one of another state before, or the folder of one of
    many parts; None: it begins anew."""

    def own(path: Path) -> bool:
        return path.exists() and path.stat().st_mtime >= began

    for name in LAST:
        if own(folder / name):
            return str(folder / name)
    return (
        str(folder)
        if any(own(path) for pattern in PARTS for path in folder.glob(pattern))
        else None
    )
