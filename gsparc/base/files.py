"""Files and folders that appear whole or not at all, also under a kill or on a full disk;
tables in YAML.
"""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gsparc.base.errors import DataError, readable
from gsparc.base.limits import DEEPEST, LEAST_CONTENT, LEAST_NODES, LONGEST_LINE, MOST_GROWTH

SUMMARY = "summary.json"  # of a finished run, written last
# One, settings beside its name, or several of either
Files = str | Path | Mapping[str, Any] | Sequence[Any]
POINTER = b"version https://git-lfs"


def platform_cache() -> Path:
    """Return where caches live on this machine: `$XDG_CACHE_HOME/gsparc` or `~/.cache/gsparc`."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "gsparc"


def read_text(path: Path, missing_message: str, kind: str = "text") -> str:
    """Read a text in UTF-8; `DataError` says `missing_message`,
    or that it is not readable as `kind`.
    """
    with readable(path, f"not readable as {kind}", (UnicodeDecodeError, OSError), missing_message):
        return path.read_text(encoding="utf-8-sig")


def read_csv(path: Path, missing_message: str) -> list[list[str]]:
    """Read cells of each line, between commas; `DataError` as of `read_text`."""
    text = read_text(path, missing_message, "CSV text")
    with readable(path, "not readable as CSV text", csv.Error):
        return list(csv.reader(map(partial(check_line_length, path), count(1), io.StringIO(text))))


def read_shipped_table(package: str, name: str) -> list[dict[str, str]]:
    """Read rows of a table in CSV that a package brings, by its heads."""
    text = files(package).joinpath(name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def refuse_repeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a record of JSON, as `object_pairs_hook` does;
    `ValueError` where a name is twice in it.
    """
    record = dict(pairs)
    if len(record) < len(pairs):
        twice = next(
            name for name, count in Counter(name for name, _ in pairs).items() if count > 1
        )
        raise ValueError(f"{twice!r} is twice in one record")
    return record


def check_line_length(path: str | Path, number: int, line: str) -> str:
    """Return the line of a table; DataError where it is longer than `LONGEST_LINE`."""
    if len(line) > LONGEST_LINE:
        fault = (
            f"{len(line):,} characters; expected at most {LONGEST_LINE:,}, and a line for each row"
        )
        raise DataError(f"{path}, line {number}: {fault}")
    return line


def refuse_git_pointer(path: Path) -> None:
    """Raise `DataError` of a file that only says where Git keeps its content."""
    with suppress(OSError), path.open("rb") as file:  # said where it is read
        if file.read(len(POINTER)) == POINTER:
            raise DataError(
                f"{path}: not the file but a Git LFS pointer to it; git lfs pull fetches it"
            )


def check_content(path: str | Path, text: str | bytes, marks: str) -> None:
    """Raise `DataError` of a large text of which hardly more is left without one
    of marks than the marks.
    """
    for mark in marks if len(text) > LONGEST_LINE else "":
        if LEAST_CONTENT * text.count(mark if isinstance(text, str) else mark.encode()) > len(text):  # type: ignore[arg-type]
            fault = f"nearly nothing but {mark!r} in {len(text):,} characters"
            raise DataError(f"{path}: {fault}; expected values")


def check_depth(source: str | Path, text: str) -> None:
    """Raise `DataError` of a text with more than `DEEPEST` brackets in brackets,
    which parsers hang on.
    """
    depth = 0
    for start in range(0, len(text), LONGEST_LINE):
        codes = np.frombuffer(
            text[start : start + LONGEST_LINE].encode("utf-32-le", "replace"), "<u4"
        )
        opened, closed = (
            np.isin(codes, OPENING).astype(np.int32),
            np.isin(codes, CLOSING).astype(np.int32),
        )
        depths = depth + np.cumsum(opened - closed)
        if depths.max(initial=0) > DEEPEST:
            raise DataError(
                f"{source}: more than {DEEPEST} brackets within brackets; expected a table"
            )
        depth = int(depths[-1])


OPENING, CLOSING = ([*map(ord, brackets)] for brackets in ("[{", "]}"))


def load_yaml(text: str, source: str | Path) -> Any:
    """Read what a text in YAML holds.

    Raises:
        DataError: aliases that repeat without end, or nearly.
        yaml.YAMLError, ValueError, RecursionError: it is none.
    """
    check_depth(source, text)
    loader, sizes = yaml.SafeLoader(text), dict[int, float]()
    node = loader.get_single_node()
    if node is None:
        return None
    if _expanded(node, sizes) > MOST_GROWTH * len(sizes) + LEAST_NODES:
        raise DataError(f"{source}: YAML whose aliases repeat without end")
    return loader.construct_document(node)


def _expanded(node: yaml.Node, sizes: dict[int, float]) -> float:
    """Number of nodes where aliases are written out; `sizes` holds those that are counted,
    by identity.
    """
    if id(node) not in sizes:
        sizes[id(node)] = math.inf  # of one inside itself
        inside = [] if isinstance(node, yaml.ScalarNode) else node.value
        parts = [
            part for entry in inside for part in (entry if isinstance(entry, tuple) else (entry,))
        ]
        sizes[id(node)] = 1 + sum(_expanded(part, sizes) for part in parts)
    return sizes[id(node)]


def read_yaml(path: Path, missing_message: str, expected: str) -> Mapping[str, Any]:
    """Read a table in YAML.

    Args:
        path: of the file.
        missing_message, expected: what the message says is wanted where there is no file, or no
            table in it.

    Raises:
        DataError: missing, not readable, or no table.
    """
    with readable(path, "not readable as YAML", (yaml.YAMLError, ValueError, RecursionError)):
        content = load_yaml(read_text(path, f"missing; expected {missing_message}", "YAML"), path)
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: expected {expected}")
    return content


def check_yaml(folder: str | None) -> None:
    """Refuse (DataError) brackets or aliases without end in configurations,
    which Hydra would write out.
    """
    for path in () if folder is None else sorted(Path(folder).rglob("*.yaml")):
        text = path.read_bytes()
        # Hydra says so, where it reads it
        with suppress(yaml.YAMLError, UnicodeDecodeError, RecursionError):
            check_depth(path, text.decode())
            _ = load_yaml(text.decode(), path) if b"&" in text and b"*" in text else None


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Open a path beside `path` to write a file to; its folder is made.

    When the block ends the file is on the disk and takes the place of `path`. A block that fails
    leaves what was there, and nothing else.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = _partial(path)
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write text, in UTF-8, or bytes, whole or not at all."""
    with whole_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def write_archive(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name as npz, whole or not at all."""
    # An open file: given a name without .npz, which that of an unfinished file is,
    # NumPy appends it.
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def write_samples(path: str | Path, columns: Mapping[str, Any]) -> None:
    """Write equally long columns as CSV, atomically; NaN becomes an empty cell.

    Raises:
        ValueError: columns are not of the same length.
    """
    import pandas as pd  # half a second, which most commands' --help does without

    # object: pandas would write whole numbers beside empty cells as 3.0.
    frame = pd.DataFrame(columns, dtype=object)
    write_whole(path, frame.to_csv(index=False, lineterminator="\n"))


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """Open an empty folder beside `path`, which must not exist,
    and which it becomes when the block ends.

    For contents that are a function of the name: where another process made `path` meanwhile,
    that one stays.
    """
    path = Path(path)
    partial = _partial(path)
    # Of a killed process, whose number this one has again
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        try:
            os.rename(partial, path)
        except OSError:
            if not path.is_dir():
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def is_out_of_space(error: BaseException | None) -> bool:
    """Tell whether a full disk, quota or limit is behind an error, or behind what caused it."""
    full = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
    return any(isinstance(cause, OSError) and cause.errno in full for cause in list_causes(error))


def list_causes(error: BaseException | None) -> list[BaseException]:
    """Return an error, what caused it, and so on; each once,
    as one raised again may be its own context.
    """
    causes: list[BaseException] = []
    while error is not None and error not in causes:
        causes.append(error)
        error = error.__cause__ or error.__context__
    return causes


def set_aside(folder: Path, *patterns: str) -> bool:
    """Rename files of an earlier run to `NAME.earlier`; return whether there were any."""
    files = [path for pattern in patterns for path in folder.glob(pattern)]
    return any([path.replace(f"{path}.earlier") for path in files])


def delete_partial_files(folder: Path) -> None:
    """Delete what processes that are gone left half written in a folder
    that nobody else writes to.
    """
    for path in [
        path for above in ("", "*/", "*/*/") for path in folder.glob(f"{above}.*.partial")
    ]:
        pid = path.name.split(".")[-2]
        if pid.isdecimal() and (int(pid) == os.getpid() or not _runs(int(pid))):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _runs(pid: int) -> bool:
    """Whether there is a process of this number, ours or anybody's."""
    try:
        os.kill(pid, 0)
    except (OSError, OverflowError) as error:
        return isinstance(error, PermissionError)
    return True


def _partial(path: Path) -> Path:
    """A name of this process alone: several may fill one cache."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")
