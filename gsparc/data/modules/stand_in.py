"""What takes the place of a release that is not on disk, and how such folders are written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np


class StandIn(Protocol):
    """Simulated measurements in a release's layout, handed to the release's module by the configuration."""

    def folder(self) -> Path:
        """Where they are; simulated when they are not there yet.

        Raises:
            ValueError: settings that cannot be simulated.
        """


def made_once(folder: Path, write: Callable[[Path], None]) -> Path:
    """The folder, written when it is not there yet."""
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        write(folder)
    return folder


def write_split(folder: Path, count: int, seed: int, first: int = 0, form: str = "%d") -> None:
    """The rows' numbers from `first` on, a random fifth of them for testing, in a text file each."""
    order, test = np.random.default_rng(seed).permutation(count) + first, max(round(0.2 * count), 1)
    for name, rows in (("test", order[:test]), ("train", order[test:])):
        np.savetxt(folder / f"{name}_index.txt", np.sort(rows), fmt=form)
