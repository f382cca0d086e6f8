"""Shards of a simulation on disk: each written once and atomically, and counted only when complete.

HDF5 does not survive a kill, so nothing is appended to: each shard is a file of its own that
appears by renaming, and the dataset is written from all of them at the end.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.files import whole_file, write_whole

ROWS = "rows"  # of a shard: which rows of the dataset it holds
NOTE = "choice.json"


class Shards:
    """The folder `FILE.parts` beside a dataset that is being made.

    Args:
        out: the dataset's file.
        plan: everything that decides what the shards hold.

    Raises:
        ValueError: the folder belongs to another simulation.
    """

    def __init__(self, out: Path, plan: Mapping[str, Any]) -> None:
        self.out, self.plan = out, json.dumps(plan, sort_keys=True, indent=1, default=str)
        self.folder = out.with_name(out.name + ".parts")
        self._removed = out.with_name(out.name + ".gone")
        self._sweep()
        stored = self.folder / "plan.json"
        if stored.exists() and stored.read_text(encoding="utf-8") != self.plan:
            raise ValueError(
                f"{self.folder} holds parts of a different simulation; remove it, or choose "
                "another out="
            )
        if not stored.exists():
            write_whole(stored, self.plan)

    def write_note(self, content: Mapping[str, Any]) -> None:
        """Store a decision, so that a resumed run does not decide again."""
        write_whole(self.folder / NOTE, json.dumps(content, indent=1, default=np.ndarray.tolist))

    def read_note(self) -> dict[str, Any] | None:
        """Return the stored decision, or None."""
        path = self.folder / NOTE
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    @property
    def signature(self) -> dict[str, str]:
        """Attribute of the dataset that says which plan it was made by."""
        return {"plan_sha256": hashlib.sha256(self.plan.encode()).hexdigest()}

    def path(self, number: int) -> Path:
        """Return the file of a shard; it is there once the shard is finished."""
        return self.folder / f"shard_{number:04d}.npz"

    def write(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a shard, whole or not at all."""
        with whole_file(self.path(number)) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)

    def list_shards(self) -> list[int]:
        """Return numbers of the shards that are there."""
        return sorted(
            int(path.stem.removeprefix("shard_")) for path in self.folder.glob("shard_*.npz")
        )

    def read(self, number: int, *names: str) -> dict[str, np.ndarray]:
        """Return the arrays of a finished shard; `names` alone where given."""
        with np.load(self.path(number), allow_pickle=False) as file:
            return {name: file[name] for name in names or file.files}

    def remove(self) -> None:
        """Remove everything, after the dataset is written."""
        # Renamed first: a kill amid the removal would leave shards without the plan
        # that they belong to.
        self._sweep()
        os.replace(self.folder, self._removed)
        self._sweep()

    def _sweep(self) -> None:
        if self._removed.exists():
            shutil.rmtree(self._removed)
