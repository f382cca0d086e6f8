"""A splatted field of a second, trained once."""

from __future__ import annotations

import pytest
from campaigns import brief, compose, spectra

from gsparc.commands.train import Objects, train


@pytest.fixture(scope="session")
def field(tmp_path_factory) -> Objects:
    """Forty Gaussians on forty spectra of 16 x 32 pixels, the receiver static."""
    folder = tmp_path_factory.mktemp("tradeoff")
    return train(compose(*brief(spectra(folder / "own.npz"))), folder / "run")[1]
