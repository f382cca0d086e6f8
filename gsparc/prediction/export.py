"""Predictions as a PHY wants them: on a resource grid, or as the paths they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.models.method import HasPaths, Method, Prediction
from gsparc.models.uplink.interface import SeparatesPaths, UplinkMethod
from gsparc.ops import Pose
from gsparc.prediction.resource_grid import interpolated, resource_grid

WITH_PATHS = "(model=image_source_gp and directional_gp are, or uplink with uplink=)"


@dataclass(frozen=True)
class Paths:
    """Plane waves at the array: N for each of B snapshots or positions.

    The channel at f is the sum of `gain exp(-j 2 pi (f - reference_hz) delay_s)`, at positions times
    `reference_hz / f`.

    Attributes:
        gain: complex64, physical units, at `reference_hz`: (B, N) at the array's middle for snapshots,
            (B, A, N) at every antenna for positions.
        delay_s: like `gain` [s]; of snapshots up to their own timing.
        reference_hz: the middle of the uplink's band, or the carrier [Hz].
        cosines: (B, N, 2) direction cosines along the array's two widest axes; None for positions.
        direction: (B, N, 3) unit vectors in the world towards where a path comes from; None for snapshots.
    """

    gain: np.ndarray
    delay_s: np.ndarray
    reference_hz: float
    cosines: np.ndarray | None = None
    direction: np.ndarray | None = None

    def channel(self, frequency_hz: np.ndarray) -> np.ndarray:
        """The sum of the paths (B, A, K) complex64 at tones (K,) [Hz], of paths at positions.

        `csi` less this is what the model adds to channels that are no paths: a residual, or other solutions.
        """
        tones = np.atleast_1d(np.asarray(frequency_hz, np.float64))
        turns = ((tone - self.reference_hz) * self.delay_s for tone in tones)
        summed = [(self.gain * np.exp(-2j * np.pi * turn)).sum(axis=-1) for turn in turns]
        return (np.stack(summed, axis=-1) * self.reference_hz / tones).astype(np.complex64)


def judged(method: Method, site: Site, uplink: Any) -> Prediction:
    """Channels of the measured tones in stored units with their confidence and variance; see `heard`."""
    return _reader(method).from_uplink(_snapshots(method, site, uplink))


def uplink_channels(method: Method, site: Site, uplink: Any, frequency_hz: Any = None) -> Tensor:
    """Channels (B, A, K) in physical units from uplinks (B, U, L) in physical units.

    Raises:
        ValueError: the model reads no uplink, or one of another shape.
    """
    snapshots = _snapshots(method, site, uplink)
    if frequency_hz is None:
        frequency_hz = site.subcarriers_hz
    wanted = torch.from_numpy(np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64)))
    return _separator(method).from_uplink_at(snapshots, wanted).mean * site.target_scale


def uplink_paths(method: Method, site: Site, uplink: Any) -> Paths:
    """The sources of uplinks (B, U, L), physical units; see `heard`."""
    found = _separator(method).sources(_snapshots(method, site, uplink))
    assert site.uplink_hz is not None
    spacing = float(np.diff(np.sort(site.uplink_hz)).min())
    gain, delay = (found.gain * site.target_scale).numpy(), (found.delay.double() / spacing).numpy()
    return Paths(gain, delay, float(site.uplink_hz.mean()), cosines=found.direction.numpy())


def placed_paths(method: Method, site: Site, tx: Tensor, rx: Pose) -> Paths:
    """The paths of a coherent field at positions in local coordinates.

    Of several solutions that are averaged these are those of each that is made of paths, by its weight.

    Raises:
        ValueError: the model's channels are not made of paths.
    """
    if not isinstance(method, HasPaths):
        raise ValueError(f"paths: channels of {method.name} are not made of paths {WITH_PATHS}")
    try:
        gain, delay, direction, carrier_hz = method.paths(tx, rx)
    except ValueError as error:
        raise ValueError(f"paths: {method.name}: {error} {WITH_PATHS}") from error
    return Paths((gain * site.target_scale).numpy(), delay.numpy(), carrier_hz, direction=direction.numpy())


def on_grid(channel: Tensor, site: Site, frequency_hz: Any, symbols: int | None) -> Tensor:
    """Channels (B, A, K) at other frequencies, and with `symbols` as [rx, rx_ant, tx, tx_ant, symbols, K].

    Raises:
        ValueError: the model does not know its own frequencies, or those wanted lie outside its band.
    """
    if frequency_hz is not None:
        if site.subcarriers_hz is None:
            raise ValueError("frequency_hz= needs a model that knows its own frequencies")
        wanted = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        tone = site.subcarriers_hz[0]
        if len(site.subcarriers_hz) == 1 and not np.allclose(wanted, tone, rtol=1e-9, atol=0):
            raise ValueError(
                f"frequency_hz=: {site.name} was measured at {tone / 1e6:.3f} MHz alone and tells "
                "nothing of others; where a field is made of sources, .paths(...) has their gains and delays"
            )
        channel = interpolated(channel, site.subcarriers_hz, wanted)
    return channel if symbols is None else resource_grid(channel, symbols, site.moving_end)


def _reader(method: Method) -> UplinkMethod:
    if not isinstance(method, UplinkMethod):
        raise ValueError(f"uplink=: {method.name} reads no uplink, it predicts at positions")
    return method


def _separator(method: Method) -> SeparatesPaths:
    if not isinstance(method, SeparatesPaths):
        raise ValueError(f"uplink=: {method.name} knows only the measured tones, no paths (model=uplink)")
    return method


def _snapshots(method: Method, site: Site, uplink: Any) -> Tensor:
    _reader(method)
    if site.uplink_array is None or site.uplink_hz is None:
        raise ValueError(f"uplink=: {site.name} has no uplink")
    shape = (len(site.uplink_array), len(site.uplink_hz))
    given = torch.as_tensor(uplink).to(torch.complex64)
    given = given[None] if given.ndim == 2 else given
    if given.ndim != 3 or given.shape[1:] != shape:
        raise ValueError(f"uplink=: expected (B, {shape[0]}, {shape[1]}) complex, got {tuple(given.shape)}")
    if not torch.isfinite(torch.view_as_real(given)).all():
        raise ValueError("uplink=: holds NaN or Inf")
    return given / site.target_scale
