"""Small invented campaigns, and the real subset where it is present."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from invented import divide, invent

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split

REAL_DATA = Path(__file__).parents[1] / ".." / "shared" / "data"


@pytest.fixture(scope="session")
def real_rfid() -> Path:
    """Folder of the real subset."""
    folder = REAL_DATA / "rfid-s23-160"
    if not folder.is_dir():
        pytest.skip(f"real data not present at {folder}")
    return folder


@pytest.fixture(scope="session")
def campaign() -> Callable[..., Measurements]:
    """`campaign(kind, rows, static_end, seed)`: an invented dataset."""
    return invent


@pytest.fixture(scope="session")
def folds() -> Callable[..., Split]:
    """`folds(rows, folds)`: a split of it."""
    return divide
