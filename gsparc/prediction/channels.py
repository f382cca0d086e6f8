"""Predictions as a PHY wants them: on a resource grid, or as the paths they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Site
from gsparc.models.abilities import HasPaths
from gsparc.models.method import Method
from gsparc.models.uplink.interface import SeparatesPaths, UplinkMethod
from gsparc.ops import Pose

# Channels are taken to lie within this long a delay window about their mean delay
WINDOW_S = 1.5e-6
REGULARISED = 1e-4
SUBCARRIERS_PER_BLOCK = 12


def centred_grid(middle_hz: float, spacing_hz: float, count: int) -> np.ndarray:
    """Return frequencies (count,) [Hz] of a grid about `middle_hz`.

    >>> centred_grid(100.0, 10.0, 4).tolist()
    [85.0, 95.0, 105.0, 115.0]
    """
    return middle_hz + (np.arange(count) - (count - 1) / 2) * spacing_hz


def interpolate_tones(channel: Tensor, tones_hz: np.ndarray, wanted_hz: np.ndarray) -> Tensor:
    """Return channels (..., K) at tones (K,) [Hz] as (..., W)
    at other frequencies of the same band.

    The best linear interpolation of channels whose delays fill `WINDOW_S` evenly about their mean;
    a single tone is repeated.

    >>> tones = centred_grid(2.4e9, 1e6, 16)
    >>> channels = torch.ones(1, 16, dtype=torch.complex64)
    >>> between = interpolate_tones(channels, tones, tones[:-1] + 0.5e6)
    >>> between.shape, bool((between[0, 5:10] - 1).abs().max() < 0.05)  # of a channel without delay
    (torch.Size([1, 15]), True)

    Raises:
        ValueError: a wanted frequency lies more than a tone outside the band.
    """
    if len(tones_hz) == 1:
        return channel.expand(*channel.shape[:-1], len(wanted_hz)).clone()
    step = float(np.diff(np.sort(tones_hz)).min())
    if wanted_hz.min() < tones_hz.min() - step or wanted_hz.max() > tones_hz.max() + step:
        raise ValueError(
            f"the grid spans {wanted_hz.min() / 1e6:.3f} to {wanted_hz.max() / 1e6:.3f} MHz, the "
            "tones "
            f"{tones_hz.min() / 1e6:.3f} to {tones_hz.max() / 1e6:.3f} MHz: take fewer blocks"
        )
    # Tones a step apart tell delays within 1 / step alone from each other.
    window = min(WINDOW_S, 0.8 / step)
    # The mean delay is taken off and put back: the window lies about it.
    steps = (channel[..., 1:] * channel[..., :-1].conj()).sum(-1)
    turn = torch.angle(steps) if len(tones_hz) > 2 else torch.zeros(channel.shape[:-1])
    middle = float(tones_hz.mean())
    straight = channel * torch.polar(
        torch.ones(()), -turn[..., None] * torch.from_numpy((tones_hz - middle) / step).float()
    )
    # Delays spread evenly over a window correlate over frequency as a sinc:
    # this is the Wiener filter.
    gram = np.sinc(window * (tones_hz[:, None] - tones_hz)) + REGULARISED * np.eye(len(tones_hz))
    cross = np.sinc(window * (wanted_hz[:, None] - tones_hz))
    matrix = torch.from_numpy(np.linalg.solve(gram, cross.T)).to(channel.dtype)
    back = torch.polar(
        torch.ones(()), turn[..., None] * torch.from_numpy((wanted_hz - middle) / step).float()
    )
    return (straight @ matrix) * back


def resource_grid(channel: Tensor, symbols: int, site: Site) -> Tensor:
    """Return channels (B, A, K), or (B, T, A, K) of T stations, constant within a slot, as Sionna's
    `[batch, rx, rx_ant, tx, tx_ant, symbols, K]`.

    Places are on `batch`, stations on the end that stands, antennas on `site.antenna_end`.

    >>> channels = torch.ones(5, 1, 12, dtype=torch.complex64)
    >>> resource_grid(channels, 14, predictor.site).shape
    torch.Size([5, 1, 1, 1, 1, 14, 12])
    """
    stations = channel if channel.ndim == 4 else channel[:, None]
    slots = stations[:, :, :, None, None, None].expand(-1, -1, -1, -1, -1, symbols, -1)
    of_stations, of_antennas = (
        {"rx": 1, "tx": 3}[site.still_end],
        {"rx": 2, "tx": 4}[site.antenna_end],
    )
    return slots.movedim((1, 2), (of_stations, of_antennas))


WITH_PATHS = "(model=image_source_gp and directional_gp are, or uplink with uplink=)"


@dataclass(frozen=True)
class Paths:
    """Plane waves at the array: N for each of B snapshots or positions.

    The channel at f is the sum of `gain exp(-j 2 pi (f - reference_hz) delay_s)`, at positions
    times `reference_hz / f`: `channel` sums them so, and `csi` is that and what is no path.

    Attributes:
        gain: complex64, physical units, at `reference_hz`: (B, N) at the array's middle for
            snapshots, (B, A, N) at every antenna for positions.
        delay_s: like `gain` [s]; of snapshots up to their own timing.
        reference_hz: the middle of the uplink's band, or the carrier [Hz].
        cosines: (B, N, 2) direction cosines along the array's two widest axes; None for positions.
        direction: (B, N, 3) unit vectors in the world towards where a path comes from; None for
            snapshots.
    """

    gain: np.ndarray
    delay_s: np.ndarray
    reference_hz: float
    cosines: np.ndarray | None = None
    direction: np.ndarray | None = None

    def channel(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Return the sum of the paths (B, A, K) complex64 at tones (K,) [Hz],
        of paths at positions.

        `csi` less this is what the model adds to channels that are no paths: a residual,
        or other solutions.
        """
        tones = np.atleast_1d(np.asarray(frequency_hz, np.float64))
        turns = ((tone - self.reference_hz) * self.delay_s for tone in tones)
        summed = [(self.gain * np.exp(-2j * np.pi * turn)).sum(axis=-1) for turn in turns]
        # By Friis a path's amplitude is proportional to the wavelength.
        return (np.stack(summed, axis=-1) * self.reference_hz / tones).astype(np.complex64)


def uplink_channels(method: Method, site: Site, uplink: Any, frequency_hz: Any = None) -> Tensor:
    """Return channels (B, A, K) in physical units from uplinks (B, U, L) in physical units.

    Raises:
        ValueError: the model reads no uplink, or one of another shape.
    """
    query = uplink_query(method, site, uplink)
    if frequency_hz is None:
        return method.predict(query).mean * site.target_scale
    wanted = torch.from_numpy(np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64)))
    assert query.uplink is not None
    return _require_paths(method).predict_from_uplink(query.uplink, wanted).mean * site.target_scale


def uplink_paths(method: Method, site: Site, uplink: Any) -> Paths:
    """Return the sources of uplinks (B, U, L), physical units; see `uplink_query`."""
    query = uplink_query(method, site, uplink)
    assert query.uplink is not None and site.uplink_hz is not None
    sources = _require_paths(method).find_sources(query.uplink)
    # Delays of sources are in turns per tone: over the spacing they are seconds.
    spacing = float(np.diff(np.sort(site.uplink_hz)).min())
    gain, delay = (
        (sources.gain * site.target_scale).numpy(),
        (sources.delay.double() / spacing).numpy(),
    )
    return Paths(gain, delay, float(site.uplink_hz.mean()), cosines=sources.direction.numpy())


def paths_at(method: Method, site: Site, query: Query) -> Paths:
    """Return the paths of a coherent field at positions in local coordinates.

    Of several solutions that are averaged these are those of each that is made of paths,
    by its weight.

    Raises:
        ValueError: the model's channels are not made of paths.
    """
    if not isinstance(method, HasPaths):
        raise ValueError(f"paths: channels of {method.name} are not made of paths {WITH_PATHS}")
    try:
        gain, delay, direction, carrier_hz = method.paths(query)
    except ValueError as error:
        raise ValueError(f"paths: {method.name}: {error} {WITH_PATHS}") from error
    return Paths(
        (gain * site.target_scale).numpy(), delay.numpy(), carrier_hz, direction=direction.numpy()
    )


def to_resource_grid(channel: Tensor, site: Site, frequency_hz: Any, symbols: int | None) -> Tensor:
    """Return channels (B, A, K) or (B, T, A, K) at other frequencies, and with `symbols` as
    `resource_grid` does.

    Raises:
        ValueError: the model does not know its own frequencies, or those wanted lie outside its
            band.
    """
    if frequency_hz is not None:
        if site.subcarriers_hz is None:
            raise ValueError("frequency_hz= needs a model that knows its own frequencies")
        wanted = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        tone = site.subcarriers_hz[0]
        if len(site.subcarriers_hz) == 1 and not np.allclose(wanted, tone, rtol=1e-9, atol=0):
            raise ValueError(
                f"frequency_hz=: {site.name} was measured at {tone / 1e6:.3f} MHz alone and tells "
                "nothing of others; where a field is made of sources, .paths(...) has their "
                "gains and delays"
            )
        channel = interpolate_tones(channel, site.subcarriers_hz, wanted)
    return channel if symbols is None else resource_grid(channel, symbols, site)


def _require_paths(method: Method) -> SeparatesPaths:
    if not isinstance(method, SeparatesPaths):
        fault = f"{method.name} answers uplinks at the measured tones alone"
        raise ValueError(f"frequency_hz= and paths: {fault}; leave them out, or train model=uplink")
    return method


def uplink_query(method: Method, site: Site, uplink: Any) -> Query:
    """Return uplinks (B, U, L) or (U, L) in physical units, from places that nobody says."""
    if not isinstance(method, UplinkMethod):
        raise ValueError(f"uplink=: {method.name} reads no uplink; give tx= or rx=")
    if site.uplink_array is None or site.uplink_hz is None:
        raise ValueError(f"uplink=: {site.name} has no uplink")
    shape = (len(site.uplink_array), len(site.uplink_hz))
    values = torch.as_tensor(uplink).to(torch.complex64)
    values = values[None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[1:] != shape:
        raise ValueError(
            f"uplink=: expected (B, {shape[0]}, {shape[1]}) complex, got {tuple(values.shape)}"
        )
    if not torch.isfinite(torch.view_as_real(values)).all():
        raise ValueError("uplink=: holds NaN or Inf")
    nowhere = torch.full((len(values), 3), torch.nan)
    return Query(nowhere, Pose.identity(nowhere), uplink=values / site.target_scale)
