"""Full disk: a checkpoint or a dataset that no longer fits.

Remedy: written beside and renamed, so that the good one survives; the error is one line that says
which file (gsparc/models/checkpoint.py, gsparc/tables/raw.py). Shown with a limit on the size of
files, which fails like a full disk does: in the middle of writing.
"""

from pathlib import Path

import pytest
from crashes import Limited

from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.training.context import FitContext


@pytest.fixture
def fitted(campaign, folds, tmp_path):
    from gsparc.models.baselines.gp import GaussianProcess

    method = GaussianProcess()
    method.fit(campaign("spectrum", 30), folds(30).folds[0], FitContext(tmp_path))
    return method


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_checkpoint_that_does_not_fit_leaves_the_one_before(fitted, tmp_path):
    path = tmp_path / "m.ckpt"
    checkpoint.save(path, fitted)
    before, names = path.read_bytes(), left(tmp_path)
    with (
        Limited(len(before) // 2),
        pytest.raises(CheckpointError, match=r"m\.ckpt: cannot be written \(") as e,
    ):
        checkpoint.save(path, fitted)
    assert "\n" not in str(e.value) and path.read_bytes() == before and left(tmp_path) == names
