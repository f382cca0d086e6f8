"""Models small enough to be trained here: spectra of rendered Gaussians,
and powers of two stations.
"""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest
from campaigns import brief, compose, spectra
from towns import town_model

from gsparc.apps.view.building import open_model
from gsparc.apps.view.site_view import SiteView, lay_power_plane
from gsparc.commands.train import train


@cache
def rendered() -> Path:
    """A checkpoint of 40 Gaussians."""
    folder = Path(mkdtemp())
    train(compose(*brief(spectra(folder / "spectra.npz"))), folder)
    return folder / "model.ckpt"


@pytest.fixture
def spectrum_view() -> SiteView:
    """A model of spectra."""
    return SiteView(open_model(rendered()))


@pytest.fixture
def power_view() -> SiteView:
    """A model of powers of two stations."""
    viewed = open_model(town_model())
    return SiteView(viewed, grid=lay_power_plane(viewed, {"area": [0, 0, 80, 60], "step_m": 2.0}))
