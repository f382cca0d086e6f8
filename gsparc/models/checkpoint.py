"""One file per trained method: everything needed to predict again, written atomically,
read without code.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
import yaml

from gsparc.base.archives import verified_archive
from gsparc.base.errors import DataError
from gsparc.base.files import list_causes, load_yaml, whole_file
from gsparc.base.locks import hold_file
from gsparc.data.schema import Site, Stations
from gsparc.models.checkpoint_content import (
    FORMAT,
    VERSION,
    CheckpointError,
    check_content,
    content_digest,
    find_non_finite,
    tensors_to_numpy,
    to_stored_types,
)
from gsparc.models.method import Method, import_path
from gsparc.ops import SphereGrid

RENAMED = {"freedom": "unknown_factor"}  # facts of sites in older checkpoints
# Classes in configurations of older checkpoints
MOVED = ("gsparc.data.datasets.", "gsparc.datasets.")
MODEL = "model.ckpt"  # of a run's folder
WAIT_S = 60.0  # for others who write a file: a large file of later rows takes seconds


@dataclass(frozen=True)
class StoredModel:
    """What a checkpoint file holds.

    Attributes:
        method: the method's name in tables.
        target: its class, as an import path.
        config: the run's configuration, YAML text ("" when there was none).
        site: the dataset's fixed facts (normalisation, grid, origin, box, array, carrier).
        state: what `Method.restore` needs.
        extra: what a trainer or harness added (optimizer, random states, position in the data
            order, split).
        path: the file.
        sha256: of all that it holds; "" of older files.
    """

    method: str
    target: str
    config: str
    site: Site
    state: dict[str, Any]
    extra: dict[str, Any] = field(default_factory=dict)
    path: Path = Path()
    sha256: str = ""

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration as plain containers; empty when there was none.

        Raises:
            CheckpointError: it is not YAML, or has interpolations, or aliases without end.
        """
        if (
            "${" in self.config
        ):  # ours are resolved; another's would fetch what the reader's environment holds
            raise CheckpointError(
                f"{self.path}: its configuration has ${{...}}, which gsparc never writes"
            )
        try:
            loaded = load_yaml(self.config.replace(*MOVED), self.path)
        except DataError as error:
            raise CheckpointError(str(error)) from None
        except (yaml.YAMLError, RecursionError, ValueError):
            damaged = f"{self.path}: its configuration is not YAML; the file is damaged"
            raise CheckpointError(damaged) from None
        if not isinstance(loaded, dict):
            return {}
        if isinstance(model := loaded.get("model"), dict):
            model.pop("budget_s", None)  # of files when seconds ended fits
        return loaded


def save(
    path: str | Path, method: Method, config: str = "", extra: Mapping[str, Any] | None = None
) -> None:
    """Write `method` and its site; the file appears whole or not at all,
    also under a kill or a full disk.

    Args:
        path: file to write or replace.
        method: fitted.
        config: YAML text of the run's configuration, interpolations resolved.
        extra: tensors, numbers, strings, None, nested dicts and lists.

    Raises:
        CheckpointError: something in the state is of another type or not finite, its place is
            named; there is no room; or another process writes the file.
    """
    if method.site is None:
        raise CheckpointError(
            f"{path}: {method.name} has not been fitted, there is nothing to store"
        )
    content = {
        "format": FORMAT,
        "version": VERSION,
        "config": config,
        "method": method.name,
        "target": import_path(method.stored_class),
        "site": to_stored_types(asdict(method.site), "site"),
        "state": to_stored_types(method.state(), "state"),
        "extra": to_stored_types(dict(extra or {}), "extra"),
    }
    with _one_writer(Path(path), WAIT_S):
        _write(Path(path), content)


class Rewriting:
    """A checkpoint that nobody else writes meanwhile; see `rewriting`.

    Args:
        path: the file that is read.
        out: the file that is written.

    Attributes:
        stored: what the file holds.
    """

    def __init__(self, path: Path, out: Path) -> None:
        self._content, self._out = _read_content(path), out
        self.stored = _stored_from_content(self._content, path)  # refuses what is incomplete

    def store(self, extra: Mapping[str, Any]) -> None:
        """Add to (or replace in) `stored.extra`; everything else in the file stays as it is.

        Raises:
            CheckpointError: as `save` does; the file is then as it was.
        """
        self._content["extra"] = {**self._content["extra"], **to_stored_types(dict(extra), "extra")}
        self.stored = _write(self._out, self._content)


@contextmanager
def rewriting(
    path: str | Path, out: str | Path | None = None, wait_s: float = WAIT_S
) -> Iterator[Rewriting]:
    """Hold a checkpoint from reading to writing: of two who add to it at once,
    one waits for the other.

    With `out` the result is another file, and `path` stays.

    >>> with rewriting("model.ckpt") as file:
    ...     file.store({"note": len(file.stored.extra)})

    Raises:
        CheckpointError: as `read` does; or others wrote it for so long [s].
    """
    target = Path(path if out is None else out)
    with _one_writer(target, wait_s):
        yield Rewriting(Path(path), target)


def update_extra(path: str | Path, extra: Mapping[str, Any]) -> None:
    """Add to a checkpoint what does not depend on what is in it; see `Rewriting.store`."""
    with rewriting(path) as file:
        file.store(extra)


@contextmanager
def _one_writer(path: Path, wait_s: float) -> Iterator[None]:
    """Hold a file that is there; of a new one nothing can be lost."""
    with ExitStack() as held:
        try:
            _ = held.enter_context(hold_file(path, wait_s)) if path.is_file() else None
        except TimeoutError as error:
            busy = f"others have been writing it for {wait_s:g} s; try again, or write another file"
            raise CheckpointError(f"{path}: {busy}") from error
        except OSError as error:
            why = error.strerror or error
            raise CheckpointError(
                f"{path}: cannot be locked ({why}); what was there is kept"
            ) from error
        yield


def _write(path: Path, content: dict[str, Any]) -> StoredModel:
    """Write what passes as it would when it is read:
    what nobody could read takes no file's place.
    """
    content.pop("sha256", None)
    check_content(content, path)
    content["sha256"] = content_digest(content)
    stored = _stored_from_content(content, path)
    try:
        with whole_file(path.resolve()) as partial, partial.open("wb") as file:
            torch.save(content, file)
    except (OSError, RuntimeError) as error:  # torch's writer makes the second of the first
        # What the system said, under whatever a library wrapped around it.
        reason = next(
            (cause.strerror for cause in list_causes(error) if isinstance(cause, OSError)), None
        )
        why = reason or "is the disk full?"
        raise CheckpointError(
            f"{path}: cannot be written ({why}); what was there is kept"
        ) from error
    return stored


def read(path: str | Path) -> StoredModel:
    """Read a checkpoint onto the CPU; runs no code from the file.

    Raises:
        CheckpointError: missing, not a checkpoint, damaged, hostile, of another version, or holding
            numbers that are NaN or infinite.
    """
    path = Path(path)
    return _stored_from_content(_read_content(path), path)


def read_interrupted(path: Path) -> StoredModel:
    """Return what an interrupted training left.

    Raises:
        ValueError: when the file holds a finished model without a trainer's state, or one that is
            not finite.
    """
    stored = read(path)
    if "trainer" not in stored.extra:
        raise ValueError(
            f"{path} holds a finished model, not a training state: resume from last.ckpt instead"
        )
    trainer = {**stored.extra["trainer"], "earlier_s": stored.extra.get("earlier_s")}
    callbacks = trainer.pop("callbacks", None)  # whose best score begins at infinity
    wrong = find_non_finite(trainer, "trainer")
    wrong = wrong or find_non_finite(callbacks, "trainer.callbacks", infinite=True)
    if wrong is not None:
        raise CheckpointError(f"{path}: {wrong} is NaN or infinite; resume from an earlier file")
    return stored


def _read_content(path: Path) -> dict[str, Any]:
    """What the archive holds, of our format and of finite numbers (CheckpointError)."""
    if path.is_dir():
        inside = [*path.glob(MODEL), *sorted(path.glob(f"fold*/{MODEL}"))]
        hint = f"say {inside[0]}" if inside else f"give the file itself, {MODEL} of a run"
        raise CheckpointError(f"{path}: a folder; {hint}")
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint")
    try:
        archive = verified_archive(path)
    except ValueError as refused:
        raise CheckpointError(f"{path}: {refused}") from None
    try:
        content = torch.load(archive, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise CheckpointError(
            f"{path}: holds Python objects that a checkpoint never holds; not loaded, it could "
            "run code"
        ) from None
    except Exception as error:  # whatever a damaged archive raises
        reason = str(error).strip().splitlines()
        why = reason[0] if reason else type(error).__name__
        raise CheckpointError(f"{path}: cannot be read ({why})") from None
    return check_content(content, path)


def _stored_from_content(content: Mapping[str, Any], path: Path) -> StoredModel:
    try:
        return StoredModel(
            method=str(content["method"]),
            target=str(content["target"]),
            config=str(content["config"]),
            site=_site_from(content["site"]),
            state=dict(content["state"]),
            extra=dict(content["extra"]),
            path=path,
            sha256=str(content.get("sha256", "")),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}: incomplete checkpoint ({type(error).__name__}: {error})"
        ) from None


def _site_from(facts: Mapping[str, Any]) -> Site:
    names = {f.name for f in fields(Site)}
    now = {RENAMED.get(k, k): v for k, v in tensors_to_numpy(facts).items()}
    values = {k: v for k, v in now.items() if k in names}
    if values.get("grid") is not None:
        values["grid"] = SphereGrid(**values["grid"])
    if values.get("stations") is not None:
        stations = values["stations"]
        values["stations"] = Stations(**{**stations, "name": tuple(stations["name"])})
    if values.get("georeference") is not None:
        from gsparc.data.georeference import Georeference

        values["georeference"] = Georeference(**values["georeference"])
    return Site(**values)
