"""From the tones that were predicted to the resource grid that a PHY wants."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

WINDOW_S = 1.5e-6  # channels are taken to lie within this long a delay window about their mean delay
REGULARISED = 1e-4
SUBCARRIERS_PER_BLOCK = 12


def centred(middle_hz: float, spacing_hz: float, count: int) -> np.ndarray:
    """Frequencies (count,) [Hz] of a grid about `middle_hz`."""
    return middle_hz + (np.arange(count) - (count - 1) / 2) * spacing_hz


def interpolated(channel: Tensor, tones_hz: np.ndarray, wanted_hz: np.ndarray) -> Tensor:
    """Channels (..., K) at tones (K,) [Hz] as (..., W) at other frequencies of the same band.

    The best linear interpolation of channels whose delays fill `WINDOW_S` evenly about their mean; a single
    tone is repeated.

    Raises:
        ValueError: a wanted frequency lies more than a tone outside the band.
    """
    if len(tones_hz) == 1:
        return channel.expand(*channel.shape[:-1], len(wanted_hz)).clone()
    step = float(np.diff(np.sort(tones_hz)).min())
    if wanted_hz.min() < tones_hz.min() - step or wanted_hz.max() > tones_hz.max() + step:
        raise ValueError(
            f"the grid spans {wanted_hz.min() / 1e6:.3f} to {wanted_hz.max() / 1e6:.3f} MHz, the tones "
            f"{tones_hz.min() / 1e6:.3f} to {tones_hz.max() / 1e6:.3f} MHz: take fewer blocks"
        )
    window = min(WINDOW_S, 0.8 / step)
    turn = _mean_turn(channel) if len(tones_hz) > 2 else torch.zeros(channel.shape[:-1])
    middle = float(tones_hz.mean())
    straight = channel * torch.polar(
        torch.ones(()), -turn[..., None] * torch.from_numpy((tones_hz - middle) / step).float()
    )
    known = np.sinc(window * (tones_hz[:, None] - tones_hz)) + REGULARISED * np.eye(len(tones_hz))
    cross = np.sinc(window * (wanted_hz[:, None] - tones_hz))
    matrix = torch.from_numpy(np.linalg.solve(known, cross.T)).to(channel.dtype)
    back = torch.polar(
        torch.ones(()), turn[..., None] * torch.from_numpy((wanted_hz - middle) / step).float()
    )
    return (straight @ matrix) * back


def _mean_turn(channel: Tensor) -> Tensor:
    """Phase per tone of the mean delay (...)."""
    return torch.angle((channel[..., 1:] * channel[..., :-1].conj()).sum(-1))


def resource_grid(channel: Tensor, symbols: int, moving_end: str) -> Tensor:
    """Channels (B, A, K) as Sionna's [rx, rx_ant, tx, tx_ant, symbols, K]; nothing moves within a slot.

    B receivers hear one transmitter of A antennas where the receiver moves; else one receiver of A antennas
    hears B transmitters.
    """
    slots = channel.unsqueeze(-2).expand(*channel.shape[:2], symbols, channel.shape[2])
    if moving_end == "rx":
        return slots[:, None, None]  # (B, 1, 1, A, symbols, K)
    return slots.transpose(0, 1)[None, :, :, None]  # (1, A, B, 1, symbols, K)
