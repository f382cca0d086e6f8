"""Predictions as a PHY wants them: on a resource grid, or as the paths they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.link.grid import interpolated, resource_grid
from gsparc.method import Method
from gsparc.uplink.method import UplinkField


@dataclass(frozen=True)
class Paths:
    """Plane waves at the array, N for each of B snapshots.

    Attributes:
        gain: (B, N) complex64 at the middle of the uplink's band, physical units.
        delay_s: (B, N) [s], up to the snapshot's own timing.
        cosines: (B, N, 2) direction cosines along the array's two widest axes.
    """

    gain: np.ndarray
    delay_s: np.ndarray
    cosines: np.ndarray


def heard(method: Method, site: Site, uplink: Any, frequency_hz: Any = None) -> Tensor:
    """Channels (B, A, K) in physical units from uplinks (B, U, L) in physical units.

    Raises:
        ValueError: the model reads no uplink, or one of another shape.
    """
    snapshots = _snapshots(method, site, uplink)
    assert isinstance(method, UplinkField)
    if frequency_hz is None:
        frequency_hz = site.subcarriers_hz
    wanted = torch.from_numpy(np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64)))
    return method.listen_at(snapshots, wanted).mean * site.target_scale


def paths(method: Method, site: Site, uplink: Any) -> Paths:
    """The sources of uplinks (B, U, L), physical units; see `heard`."""
    found = method.sources(_snapshots(method, site, uplink))  # type: ignore[attr-defined]
    assert site.uplink_hz is not None
    spacing = float(np.diff(np.sort(site.uplink_hz)).min())
    return Paths(
        (found.gain * site.target_scale).numpy(),
        (found.delay.double() / spacing).numpy(),
        found.direction.numpy(),
    )


def on_grid(channel: Tensor, site: Site, frequency_hz: Any, symbols: int | None) -> Tensor:
    """Channels (B, A, K) at other frequencies, and with `symbols` as [rx, rx_ant, tx, tx_ant, symbols, K]."""
    if frequency_hz is not None:
        if site.subcarriers_hz is None:
            raise ValueError("frequency_hz= needs a model that knows its own frequencies")
        wanted = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        channel = interpolated(channel, site.subcarriers_hz, wanted)
    return channel if symbols is None else resource_grid(channel, symbols, site.moving_end)


def _snapshots(method: Method, site: Site, uplink: Any) -> Tensor:
    if not isinstance(method, UplinkField) or site.uplink_array is None or site.uplink_hz is None:
        raise ValueError(f"uplink=: {method.name} reads no uplink, it answers positions")
    shape = (len(site.uplink_array), len(site.uplink_hz))
    given = torch.as_tensor(uplink).to(torch.complex64)
    given = given[None] if given.ndim == 2 else given
    if given.ndim != 3 or given.shape[1:] != shape:
        raise ValueError(f"uplink=: expected (B, {shape[0]}, {shape[1]}) complex, got {tuple(given.shape)}")
    if not torch.isfinite(torch.view_as_real(given)).all():
        raise ValueError("uplink=: holds NaN or Inf")
    return given / site.target_scale
