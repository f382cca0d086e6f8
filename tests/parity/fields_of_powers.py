"""Fields of powers at fixed settings: one station, several, and coherent waves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from small_worlds import LAW, rows, smooth, spread, trend

from gsparc.data.own import from_arrays
from gsparc.models.powers import waves
from gsparc.models.powers.field import PowerField
from gsparc.models.powers.together.field import JointPowerField
from gsparc.models.powers.together.learning import Own
from gsparc.models.powers.together.terms import Terms, link_rows
from gsparc.ops import Pose
from gsparc.processes.kernel import Kernel
from gsparc.processes.prior import Prior
from gsparc.processes.trend import Law, Trend

TWO = Kernel((1.2, 6.0), (0.4, 0.6), 0.08, 20.0)
Arrays = dict[str, np.ndarray]


def _seen(found: object) -> Arrays:
    names = ("mean", "variance", "unknown", "explained")
    return {name: getattr(found, name).numpy() for name in names if getattr(found, name) is not None}


def field_of_one_station() -> Arrays:
    """The field of powers without anything in the way."""
    places = spread(60, 0)
    told = rows(places)
    arrays = {"rx_position": places, "tx_position": np.array(LAW.place), "rssi_db": told.decibels}
    data = from_arrays(arrays)
    field = PowerField(data.site, trend(data.moving), TWO)
    field.condition(data, np.arange(50))
    batch = data.batch(np.arange(50, 60))
    left = field.left_out()
    return _seen(field(batch.tx, batch.rx)) | {
        "left_out": left.mean.numpy(), "left_variance": left.variance.numpy(),
        "mean_at": field(batch.tx, batch.rx).mean.numpy(),
    }  # fmt: skip


def _stations(quiet: bool) -> object:
    rng = np.random.default_rng(2)
    place = spread(45, 3, (40.0, 30.0, 1.5))
    mast = np.array([[5.0, 5, 8], [35, 10, 8], [20, 28, 9], [10, 25, 7]])
    away = np.linalg.norm(place[:, None] - mast, axis=-1)
    power = -30 - 28 * np.log10(away) + 4 * smooth(place, 4, 4, 6.0) + rng.standard_normal((45, 4))
    arrays = {"rx_position": place, "station_position": mast, "rssi_db": power}
    if quiet:
        level = np.quantile(power, 0.15)
        arrays |= {"rssi_db": np.where(power < level, np.nan, power), "sensitivity_db": np.array(level)}
    return from_arrays(arrays)


def _together(quiet: bool) -> Arrays:
    data = _stations(quiet)
    known = np.arange(len(data) - 20)
    places = np.array(data.site.stations.position, np.float64)
    about = Trend(0.0, Law(-32.0, 2.7, 1.0, 6.0, None), 1.2, 0.7)
    own = Own(Prior(TWO, about), {2: Prior(Kernel((2.0, 9.0), (0.3, 0.7), 0.1, 12.0), about)})
    terms = Terms.over(link_rows(data, known, places), about, 6.0, 15, 0)
    terms = replace(terms, place_db=1.6)
    field = JointPowerField(data.site, places, own, terms, terms, 1.3)
    field.condition(data, known)
    batch, left = data.batch(np.arange(len(data) - 20, len(data))), field.left_out()
    far = batch.tx + torch.tensor([2.0, 1.0, 0.5])
    moved = field(far, Pose(batch.rx.position + torch.tensor([1.0, 0, 0]), batch.rx.rotation))
    return _seen(field.answer(batch)) | {
        "left_out": left.mean.numpy(), "left_variance": left.variance.numpy(),
        "unheard": moved.mean.numpy(),
        "unheard_variance": moved.variance.numpy(),
    }  # fmt: skip


def field_of_four_stations() -> Arrays:
    """Stations in one field with its shared terms."""
    return _together(quiet=False)


def field_of_four_stations_censored() -> Arrays:
    """The same where some rows lie below a level."""
    return _together(quiet=True)


def coherent_waves() -> Arrays:
    """A damped step of coherent waves towards the powers of places."""
    rng = np.random.default_rng(6)
    columns = rng.standard_normal((80, 12, 2)) @ [1, 1j] / 12
    decibels = waves.decibels_of(columns @ (rng.standard_normal((12, 2)) @ [1, 1j]))
    begin = waves._Misfit.of(columns, decibels, rng.standard_normal((12, 2)) @ [1, 1j], 0.1, 2.0)
    found = waves._step(columns, decibels, begin, 0.1, 2.0, 1e-2)
    assert found is not None
    return {"power": found[0].power.astype(np.float32), "value": np.array(found[0].value, np.float32)}
