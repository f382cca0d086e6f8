"""Fetch public data from their makers' pinned revisions, checked by hash,
into one folder of the cache.
"""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from filelock import FileLock, Timeout

from gsparc.base.errors import DataError, Problems, explain_error, suggest_name
from gsparc.base.files import platform_cache, read_shipped_table
from gsparc.datasets.public.hub import fetch_from_hub

log = logging.getLogger(__name__)

MIRROR = "GSPARC_DATA_URL"  # environment variable: a server laid out as GitHub's raw files
RAW = "https://raw.githubusercontent.com"
STALLED_S = 30.0  # without a byte
CHUNK = 2**16  # bytes
# Bytes a second of a whole file, beside so many times the wait for a byte
SLOWEST, PATIENCE = 20e3, 10


@dataclass(frozen=True)
class Source:
    """One file of a set: where it is pinned, its size and its SHA-256, empty where the revision
    and the size alone pin it.
    """

    repository: str
    revision: str
    path: str
    bytes: int
    sha256: str

    @property
    def url(self) -> str:
        """Address of the raw file, at the mirror where one is set."""
        root = os.environ.get(MIRROR) or RAW
        return f"{root.rstrip('/')}/{quote(f'{self.repository}/{self.revision}/{self.path}')}"


@dataclass(frozen=True)
class PublicSet:
    """A public set of measurements; the attributes are explained in sets.yaml."""

    name: str
    what: str
    licence: str | None
    cite: str
    dataset: str | None = None
    by_hand: str | None = None
    hub: str | None = None
    strip: str = ""
    opens: str = ""
    sources: tuple[Source, ...] = ()

    @property
    def folder(self) -> Path:
        """Where its files lie once they are fetched."""
        return platform_cache() / "data" / self.name

    @property
    def size_text(self) -> str:
        """What is fetched, in words."""
        total = sum(source.bytes for source in self.sources)
        return f"{total / 1e6:.1f} MB in {len(self.sources)} file{'s' * (len(self.sources) > 1)}"

    def files(self) -> dict[Path, Source]:
        """Return sources by the path they are stored at.

        Raises:
            DataError: a path that leaves the set's folder.
        """
        placed, top = {}, self.folder.resolve()
        for source in self.sources:
            path = self.folder / source.path.removeprefix(f"{self.strip}/")
            # On Windows a backslash parts folders as well, and could lead out of this one.
            if not path.resolve().is_relative_to(top) or "\\" in source.path:
                raise DataError(
                    f"{self.name}: {source.path} would leave {self.folder}; nothing is fetched"
                )
            placed[path] = source
        return placed

    def missing(self) -> list[Path]:
        """Return files that are not there in full size."""
        # By size alone: hashes are checked when files are fetched,
        # and reading all at each start takes long.
        return [
            p
            for p, file in self.files().items()
            if not p.is_file() or p.stat().st_size != file.bytes
        ]


@cache
def public_sets() -> dict[str, PublicSet]:
    """Return every public set by its name."""
    sources: dict[str, list[Source]] = {}
    for row in read_shipped_table("gsparc.datasets.public", "sources.csv"):
        sources.setdefault(row["dataset"], []).append(
            Source(
                row["repository"], row["revision"], row["path"], int(row["bytes"]), row["sha256"]
            )
        )
    about = yaml.safe_load(
        files("gsparc.datasets.public").joinpath("sets.yaml").read_text(encoding="utf-8")
    )
    sets = {}
    for name, facts in about.items():
        # Several sets may share the files of one release (`of`), each with its own part (`match`).
        pinned, match = sources.get(facts.pop("of", name), ()), facts.pop("match", "*")
        chosen = tuple(source for source in pinned if fnmatchcase(source.path, match))
        sets[name] = PublicSet(name, by_hand=facts.pop("from", None), **facts, sources=chosen)
    return sets


def fetched_path(choice: str, setting: str = "file") -> Path:
    """Return what `dataset=<choice>` reads where its setting names nothing:
    the set as it was fetched.

    Raises:
        DataError: nothing is fetched, or only a part; says in one line how to get it.
    """
    sets = [public_set for public_set in public_sets().values() if public_set.dataset == choice]
    say = f"say dataset.{setting}={setting.upper()} for dataset={choice}"
    fetched = next((public_set for public_set in sets if public_set.sources), None)
    if fetched is not None and not (missing := fetched.missing()):
        return fetched.folder / fetched.opens
    if fetched is None:
        by_hand = [f"get it from {public_set.by_hand} and " for public_set in sets]
        raise DataError(f"dataset.{setting} is not set; {''.join(by_hand)}{say}")
    part = f", of which {len(missing)} are missing" if len(missing) < len(fetched.sources) else ""
    how = f"get it with `gsparc data {fetched.name}` ({fetched.size_text}{part})"
    raise DataError(f"dataset.{setting} is not set; {how}, or {say}")


def fetched_path_or_none(choice: str) -> Path | None:
    """Return the same as `fetched_path`; None where it is not there."""
    return Problems(choice).attempt(partial(fetched_path, choice))


def fetch(name: str, accept: bool = False, timeout_s: float = STALLED_S, retries: int = 2) -> Path:
    """Fetch what is missing or damaged of a set, file by file, and return its folder.

    Args:
        name: of the set.
        accept: whether a set whose makers state no licence is wanted all the same.
        timeout_s: after which a server that sends nothing is given up [s].
        retries: attempts after the first, of each file.

    Raises:
        DataError: unknown, fetched by hand only, not accepted, no network, a wrong file, or no
            room.
    """
    wanted = public_sets().get(name)
    if wanted is None:
        hint = suggest_name(name, public_sets())
        raise DataError(f"no public set is called {name!r}{hint}; `gsparc data` lists them")
    if not wanted.sources and wanted.hub is None:
        raise DataError(f"{name} is not fetched by this program; get it from {wanted.by_hand}")
    if wanted.sources and all(_is_right(path, source) for path, source in wanted.files().items()):
        return wanted.folder
    _licence(wanted, accept)
    try:
        wanted.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(wanted.folder / ".lock")
        try:
            guard = lock.acquire(timeout=0)
        except Timeout:
            log.warning("%s: another process fetches it; waiting for it to end", wanted.name)
            guard = lock.acquire()
        with guard:
            if wanted.hub is not None:
                return fetch_from_hub(wanted.hub, wanted.strip, wanted.folder)
            # Of a fetch that was killed: nobody else holds the lock.
            strays = {*wanted.folder.rglob("tmp*")} - wanted.files().keys()
            for stray in strays.union(wanted.missing()):
                stray.unlink(missing_ok=True)
            _fetch_files(wanted, timeout_s, retries)
    except OSError as error:
        why = error.strerror or explain_error(error)
        fault = f"cannot be written ({why}); set XDG_CACHE_HOME to a folder that can"
        raise DataError(f"{wanted.folder}: {fault}") from None
    return wanted.folder


def _is_right(path: Path, source: Source) -> bool:
    import pooch  # here, as it brings requests, which only a fetch needs

    same_size = path.is_file() and path.stat().st_size == source.bytes
    return same_size and source.sha256 in ("", pooch.file_hash(str(path)))


def _licence(wanted: PublicSet, accept: bool) -> None:
    if wanted.licence is not None:
        log.info("%s: licence %s; cite %s", wanted.name, wanted.licence, wanted.cite)
    elif not accept:
        raise DataError(
            f"{wanted.name}: its makers state no licence: ask them before you pass it on "
            f"({wanted.cite}); to "
            f"fetch it for yourself say `gsparc data {wanted.name} accept=true`"
        )


def _fetch_files(wanted: PublicSet, timeout_s: float, retries: int) -> None:
    import pooch
    import requests
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

    pooch.get_logger().setLevel(logging.WARNING)
    files = {
        path.relative_to(wanted.folder).as_posix(): file for path, file in wanted.files().items()
    }
    store = pooch.create(
        wanted.folder,
        base_url="",
        registry={
            name: f"sha256:{source.sha256}" if source.sha256 else None
            for name, source in files.items()
        },
        urls={name: source.url for name, source in files.items()},
        retry_if_failed=retries,
    )
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task(wanted.name, total=sum(source.bytes for source in wanted.sources))
        for name, source in files.items():
            try:  # of what is there, only the hash is taken
                store.fetch(name, downloader=partial(_download, source=source, timeout_s=timeout_s))
            except (requests.RequestException, ValueError) as error:
                raise DataError(_fault(source, error, wanted.name)) from None
            progress.advance(task, source.bytes)


def _download(url: str, output_file: Any, _: Any, source: Source, timeout_s: float) -> None:
    """Write what a server sends, as it sends it, until it is more than the file or takes too long.

    Raises:
        ValueError: another size.
        requests.RequestException: no such file, cut short, or out of time.
    """
    import requests
    from urllib3.exceptions import HTTPError

    end, size = time.monotonic() + PATIENCE * timeout_s + source.bytes / SLOWEST, 0
    plain = {"Accept-Encoding": "identity"}
    response = requests.get(url, headers=plain, timeout=timeout_s, stream=True)
    with response as answer, Path(output_file).open("wb") as file:
        answer.raise_for_status()
        try:
            while part := answer.raw.read1(CHUNK, decode_content=False):
                size += len(part)
                if size > source.bytes:
                    raise ValueError("more than the pinned file holds")
                if time.monotonic() > end:
                    raise requests.Timeout(f"timed out after {size:,} bytes")
                file.write(part)
            if size < source.bytes:
                raise ValueError("less than the pinned file holds")
        except HTTPError as error:
            raise requests.exceptions.ChunkedEncodingError(error) from None


def _fault(source: Source, error: Exception, name: str) -> str:
    """One line about a file that was not fetched."""
    import requests

    again = f"what is there is kept: say `gsparc data {name}` again"
    if isinstance(error, requests.HTTPError | requests.TooManyRedirects):
        return f"{source.url}: {explain_error(error).partition(' for url')[0]}; {again}"
    if "timed out" in str(error):
        slowly = (
            ("too little in the time that such a file may take")
            if "after" in str(error)
            else "nothing"
        )
        return f"{source.url}: the server sends {slowly}; {again}"
    if isinstance(error, requests.exceptions.ChunkedEncodingError) or "IncompleteRead" in str(
        error
    ):
        return f"{source.url}: cut short; {again}"
    if isinstance(error, requests.RequestException):
        return (
            f"{source.url}: not reached; is there a network? {MIRROR}=URL names a mirror; {again}"
        )
    return (
        f"{source.url}: not the {source.bytes:,} bytes of the pinned revision (SHA-256); it "
        "was not kept"
    )
