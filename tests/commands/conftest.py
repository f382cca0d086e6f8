"""Fields of a second, trained once for all commands."""

from pathlib import Path

import numpy as np
import pytest
from access_points import walks
from campaigns import brief, compose, spectra
from towns import trained

from gsparc.commands.train import TrainedRun, train


@pytest.fixture(scope="session")
def spectra_file(tmp_path_factory) -> Path:
    """Forty spectra of 16 x 32 pixels, the receiver static."""
    return spectra(tmp_path_factory.mktemp("spectra") / "own.npz")


@pytest.fixture(scope="session")
def field(spectra_file, tmp_path_factory) -> TrainedRun:
    """Forty Gaussians trained on them."""
    return train(compose(*brief(spectra_file)), tmp_path_factory.mktemp("field"))[1]


@pytest.fixture(scope="session")
def halfway(spectra_file, tmp_path_factory) -> TrainedRun:
    """The same on the training rows alone; beside its model lies the training state
    of step 15 of 20.
    """
    often = "callbacks.checkpoint.interval=15"
    config = compose(*brief(spectra_file, "model.refit=false", often))
    return train(config, tmp_path_factory.mktemp("halfway"))[1]


@pytest.fixture(scope="session")
def spectra_gp(tmp_path_factory) -> Path:
    """A checkpoint of `gp` on eighty such spectra."""
    return trained(spectra(tmp_path_factory.mktemp("gp") / "own.npz", rows=80), "gp")


@pytest.fixture(scope="session")
def fingerprints() -> dict[str, np.ndarray]:
    """Arrays of 12 walks through a hall, as a file of fingerprints holds them."""
    rows = walks(12, 0)
    own = {name: getattr(rows, name) for name in ("position", "walk", "time_s", "access_point")}
    return {"rss_dbm": rows.level, **own}
