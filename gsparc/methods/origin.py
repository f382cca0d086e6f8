"""What an interrupted training learned from and how, so that nothing else goes on from it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, indices_hash
from gsparc.methods.checkpoint import Stored
from gsparc.methods.method import FitContext

log = logging.getLogger(__name__)

DECIDING = ("model", "dataset.batch_size")  # settings that a run must share with what it goes on from
RHYTHM = ("trainer", "callbacks", "budget_s", "budget_clock", "model.refit")
"""Settings that may change on the way, and are then named."""


@dataclass(frozen=True)
class Origin:
    """Hashes of what is learned from, the seed, and the whole configuration as text.

    Attributes:
        data: content hash of the measurements.
        rows: hash of the fold's indices.
        seed: of the run.
        config: YAML text; "" from Python without one.
    """

    data: str
    rows: str
    seed: int
    config: str = ""

    @classmethod
    def of(cls, data: Measurements, fold: Fold, context: FitContext) -> Origin:
        """Of a fit that begins."""
        return cls(data.site.sha256, indices_hash((fold,)), context.seed, context.config_yaml)

    def marks(self) -> dict[str, Any]:
        """For the `extra` of a checkpoint, which holds the configuration itself."""
        return {"origin": {"data": self.data, "rows": self.rows, "seed": self.seed}}

    def refuse_other(self, stored: Stored) -> None:
        """Whether training may go on from `stored`; settings of its rhythm that changed are logged.

        Raises:
            ValueError: it is of other data, rows, seed or settings, which are named.
        """
        kept = stored.extra.get("origin", {"data": stored.site.sha256})  # earlier versions kept less
        before, now = stored.configuration, yaml.safe_load(self.config) or {}
        found = []
        for name, group, what in (("data", "dataset", "data"), ("rows", "split", "rows")):
            if kept.get(name, getattr(self, name)) != getattr(self, name):
                found.append(", ".join(_differences(before, now, (group,))) or f"other {what}")
        if kept.get("seed", self.seed) != self.seed:
            found.append(f"seed={kept['seed']} (here {self.seed})")
        found += _differences(before, now, DECIDING)
        if found:
            raise ValueError(
                f"ckpt_path={stored.path}: was trained with {'; '.join(found)}: "
                "go on with the same, or start again without ckpt_path"
            )
        changed = _differences(before, now, RHYTHM)
        if changed:
            log.warning("going on from %s, which had %s", stored.path, "; ".join(changed))


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], keys: tuple[str, ...]) -> list[str]:
    """`key=value (here other)` for every setting under `keys` that differs; none without a configuration."""
    if not before or not now:
        return []
    one, two = dict(_leaves(before)), dict(_leaves(now))
    under = [k for k in {**one, **two} if any(k == key or k.startswith(f"{key}.") for key in keys)]
    under = [k for k in under if keys is RHYTHM or k not in RHYTHM]
    return [f"{k}={one.get(k)} (here {two.get(k)})" for k in under if one.get(k) != two.get(k)]


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
