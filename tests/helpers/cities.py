"""A small city, made once a session: the stand-in with few users, and a loader for it."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.datasets.argos import load_argos
from gsparc.models.uplink.method import UplinkField
from gsparc.models.uplink.search import SearchSettings
from gsparc.simulate.argos_sim import ArgosStandIn
from gsparc.training.context import FitContext

COUNT = 120


@cache
def folder() -> Path:
    """Its folder."""
    return ArgosStandIn(count=COUNT, seed=1, root=mkdtemp()).folder()


def city(antenna: int | str = 0) -> Measurements:
    """Its measurements at true positions."""
    return load_argos(folder(), antenna=antenna, positions="true")


def fold() -> Fold:
    """80 training, 16 validation and 24 test rows."""
    rows = np.arange(COUNT)
    return Fold(rows[:80], rows[80:96], rows[96:])


@cache
def uplink_field() -> UplinkField:
    """A short search over the uplink of all antennas."""
    method = UplinkField(SearchSettings(rounds=4, picks=4, final=2), teachers=60)
    method.fit(city("all"), fold(), FitContext())
    return method


def deaf(data: Measurements) -> Measurements:
    """The same without its uplink."""
    return replace(data, uplink=None)
