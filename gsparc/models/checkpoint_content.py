"""What a checkpoint may hold: plain values, finite, of a known layout."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

VERSION = 2  # of what a checkpoint holds
FORMAT = "gsparc-checkpoint"
PARTS = {"format", "version", "config", "method", "target", "site", "state", "extra", "sha256"}
DEEPEST = 50  # of containers in containers


class CheckpointError(ValueError):
    """A file that is no readable checkpoint, or a state that cannot be written; one line,
    with the file.
    """


def content_digest(content: Mapping[str, Any]) -> str:
    """SHA-256 of all that a checkpoint holds, of tensors type, shape and bytes."""
    digest, stack = (
        hashlib.sha256(),
        [value for name, value in sorted(content.items()) if name != "sha256"],
    )
    while stack:
        value = stack.pop()
        if isinstance(value, Tensor):
            digest.update(f"{value.dtype} {tuple(value.shape)}".encode())
            packed = torch.empty(value.numel(), dtype=value.dtype).copy_(value.detach().flatten())
            # One number may have strides of 0
            digest.update(packed.view(torch.uint8).numpy().tobytes())
        elif isinstance(value, Mapping):
            digest.update(f"{len(value)} {list(value)}".encode())
            stack += value.values()
        elif isinstance(value, (list, tuple)):
            digest.update(f"{type(value)} {len(value)}".encode())
            stack += value
        else:
            digest.update(f"{value!r};".encode())
    return digest.hexdigest()


def check_content(content: Any, path: Path) -> dict[str, Any]:
    """Return what a file holds, or is to hold, if it is of our format,
    whole and of finite numbers.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path}: not a gsparc checkpoint (weights of another program?)")
    version = content.get("version")
    if version != VERSION:
        raise CheckpointError(
            f"{path}: of version {version}, this gsparc reads {VERSION}; train again with it"
        )
    if _exceeds_limits(content):  # what walks over it would not end
        raise CheckpointError(
            f"{path}: damaged (a part of it is there many times, too deep, or not there)"
        )
    # An archive's own sums are right of whatever was put in it. Older files have no sum of their
    # own: where its name is damaged there is a part too many.
    if content.keys() - PARTS or (
        "sha256" in content and content["sha256"] != content_digest(content)
    ):
        raise CheckpointError(
            f"{path}: damaged, or changed by another program; take another copy of it"
        )
    for part in ("site", "state"):
        where = find_non_finite(_drop_unknown_places(content.get(part)), part)
        if where is not None:  # its sum is right: it was written like this
            raise CheckpointError(
                f"{path}: {where} is NaN or infinite; train again, or take an earlier file"
            )
    return content


def _drop_unknown_places(part: Any) -> Any:
    """A site with 0 for NaN in places and sectors of stations: what nobody knows; else as it is."""
    stations = part.get("stations") if isinstance(part, Mapping) else None
    if not isinstance(stations, Mapping):
        return part
    facts = {name: stations.get(name) for name in ("position", "sector")}
    finite_facts = {
        name: torch.where(torch.isnan(fact), 0, fact)
        for name, fact in facts.items()
        if isinstance(fact, Tensor) and fact.is_floating_point()
    }
    return {**part, "stations": {**stations, **finite_facts}}


def tensors_to_numpy(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same facts with arrays for tensors, at any depth."""
    return {
        k: v.numpy()
        if isinstance(v, Tensor)
        else tensors_to_numpy(v)
        if isinstance(v, Mapping)
        else v
        for k, v in facts.items()
    }


def _exceeds_limits(content: Any) -> bool:
    """Whether a container is in it twice or too deep,
    or a tensor has not as many numbers as are stored.
    """
    stack, seen = [(content, 0)], set[int]()
    while stack:
        value, depth = stack.pop()
        if isinstance(value, Tensor):
            other = value.is_meta or value.is_quantized or value.is_nested
            if (
                other
                or value.layout != torch.strided
                or value.nbytes > value.untyped_storage().nbytes()
            ):
                return True
        elif isinstance(value, (Mapping, list, tuple)) and value:
            if id(value) in seen or depth > DEEPEST:
                return True
            seen.add(id(value))
            parts = value.values() if isinstance(value, Mapping) else value
            stack += [(part, depth + 1) for part in parts]
    return False


def find_non_finite(value: Any, where: str, *, infinite: bool = False) -> str | None:
    """Return where the first NaN is, or infinity unless it may be `infinite`; None:
    all are finite.
    """
    if isinstance(value, Tensor):
        wrong = torch.isnan(value) if infinite else ~torch.isfinite(value)
        return f"{where}{wrong.nonzero()[0].tolist()}" if wrong.any() else None
    if isinstance(value, float):
        return where if math.isnan(value) or (math.isinf(value) and not infinite) else None
    parts: Iterable[tuple[str, Any]] = ()
    if isinstance(value, Mapping):
        parts = ((f"{where}.{key}", entry) for key, entry in value.items())
    elif isinstance(value, (list, tuple)):
        parts = ((f"{where}[{i}]", entry) for i, entry in enumerate(value))
    each = (find_non_finite(part, name, infinite=infinite) for name, part in parts)
    return next((result for result in each if result is not None), None)


def to_stored_types(value: Any, where: str) -> Any:
    """The same value in types that weights-only unpickling accepts;
    views do not drag their storage along.
    """
    if value is None or type(value) in (bool, int, float, str, bytes):
        return value
    if isinstance(value, Tensor):
        tensor = value.detach().contiguous()
        return tensor.clone() if tensor.untyped_storage().nbytes() > tensor.nbytes else tensor
    if isinstance(value, np.ndarray):
        return to_stored_types(torch.from_numpy(np.ascontiguousarray(value)), where)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {
            to_stored_types(k, where): to_stored_types(v, f"{where}.{k}") for k, v in value.items()
        }
    if isinstance(value, (list, tuple)):
        items = [to_stored_types(v, f"{where}[{i}]") for i, v in enumerate(value)]
        return items if isinstance(value, list) else tuple(items)
    if isinstance(value, Path):
        return str(value)
    for base in (bool, int, float, str):  # enums and other named subclasses
        if isinstance(value, base):
            return base(value)
    raise CheckpointError(
        f"{where} is a {type(value).__name__}; a checkpoint holds tensors, numbers, strings"
    )
