"""A ceiling of antennas above a flat patch, as measurements and as a field of known terms."""

import numpy as np
import torch
from closed import conditioned
from rooms import WAVELENGTH

from gsparc.models.channels.field import ChannelField
from gsparc.models.channels.kernels import fibonacci_sphere
from gsparc.models.channels.prior import ChannelPrior
from gsparc.models.channels.terms import Direct, Directions, Isotropic, Leakage, Noise
from gsparc.models.channels.terms.term import Frame
from gsparc.tables.own import from_arrays

WAVENUMBER = 2 * np.pi / WAVELENGTH


def ceiling(ends=6, count=80, *, seed=0, turned=0.4, shift=(0.0, 0.0, 0.0), runs=None):
    """A transmitter in a flat patch, antennas above it: direct wave, leakage,
    waves mostly from the ends.
    """
    rng = np.random.default_rng(seed)
    place = np.c_[rng.uniform(0, 0.7, (count, 2)), np.full(count, 0.2)]
    end = np.c_[rng.uniform(-1, 2, (ends, 2)), np.full(ends, 1.8)]
    waves, channel = fibonacci_sphere(150).numpy(), np.empty((count, ends), complex)
    for number, true in enumerate(end + shift):
        away = np.linalg.norm(place - true, axis=1)
        towards = (true - place.mean(0)) / np.linalg.norm(true - place.mean(0))
        gains = rng.standard_normal((150, 2)) @ [1, 1j] * np.exp(2 * waves @ towards) / 60
        h = (
            np.exp(-1j * WAVENUMBER * away) / away
            + np.exp(1j * WAVENUMBER * place @ waves.T) @ gains
        )
        gain = np.exp(1j * turned * rng.standard_normal()) * rng.uniform(0.5, 2)
        channel[:, number] = gain * (h + 0.3 * np.exp(2j * np.pi * rng.random()))
    channel += 0.05 * (rng.standard_normal((count, ends, 2)) @ [1, 1j])
    if runs is not None:
        channel[runs == 1] *= np.exp(0.9j)
    arrays = {
        "tx_position": place,
        "station_position": end,
        "csi": channel,
        "carrier_hz": np.array(2.4e9),
    }
    run = {} if runs is None else {"run": runs}
    return from_arrays({**arrays, **run, "frequency_hz": np.array([2.4e9])})


def tied(data, rows) -> ChannelField:
    """A field of directions, leakage and the direct wave, conditioned on rows."""
    offset = torch.tensor([0.01, -0.02, 0.0]).double()
    frame = Frame(torch.from_numpy(data.moving).mean(0), 20.0, 0.6, 0.4, offset)
    power = torch.rand(13, dtype=torch.float64, generator=torch.manual_seed(0)) + 0.2
    towards = torch.tensor([1.0, 0.2, -0.5, 0.0]).double()
    prior = ChannelPrior(()).with_terms(
        Isotropic(frame, power[:1]),
        Directions(
            frame, power[1:9], angles=fibonacci_sphere(16)[:8], concentration=5.0, towards=towards
        ),
        Leakage(frame, power[9:10]),
        Direct(frame, power[10:12]),
        Noise(frame, power[12:]),
    )
    return conditioned(prior, data, rows)
