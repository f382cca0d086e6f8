"""Channels along a trajectory as a `ChannelModel` of Sionna's link level (extra `sionna`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from sionna.phy.channel import ChannelModel

from gsparc.data.raw import read_raw


class TrajectoryChannel(ChannelModel):
    """Tapped delay lines of `gsparc export to=taps`: a batch is stretches of the way, at random times.

    >>> channel = OFDMChannel(TrajectoryChannel("model-sionna/cir.npz"), resource_grid)

    Raises:
        ValueError: a batch longer than the trajectory.
    """

    def __init__(self, path: str | Path, seed: int = 0) -> None:
        super().__init__()
        arrays = read_raw(path).arrays
        # Instants are so close that a cubic spline between them errs less than the taps do.
        self._gain = CubicSpline(arrays["time_s"], arrays["gain"])
        self._time, self._delay = arrays["time_s"], torch.from_numpy(arrays["delay_s"])
        self._receives = "tx_position" in arrays  # the array does
        self._draw = np.random.default_rng(seed)

    def __call__(
        self, batch_size: int, num_time_steps: int, sampling_frequency: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Gains [B, 1, rx_ant, 1, tx_ant, L, T] complex, and delays [B, 1, 1, L] [s]; see Sionna."""
        # Samples stand at both ends: one interval fewer than their number.
        length = (num_time_steps - 1) / sampling_frequency
        spare = self._time[-1] - self._time[0] - length
        if spare < 0:
            raise ValueError(f"{length:g} s of channel from a trajectory of {np.ptp(self._time):g} s")
        # Somewhere in the trajectory, uniformly, so that a batch is of independent stretches.
        begin = self._time[0] + self._draw.uniform(0, 1, (batch_size, 1)) * spare
        gain = torch.from_numpy(self._gain(begin + np.arange(num_time_steps) / sampling_frequency))
        gain = gain.permute(0, 2, 3, 1)[:, None, :, None, None] if self._receives else (
            gain.permute(0, 2, 3, 1)[:, None, None, None])  # fmt: skip
        delay = self._delay.expand(batch_size, 1, 1, -1)
        return gain.to(self.cdtype).to(self.device), delay.to(self.dtype).to(self.device)
