"""Modulation and coding from predicted channels, and the throughput that comes of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

SYMBOLS = 12  # of a slot that carry data
CHUNK = 32
OUTAGE = 0.5  # a transport block that fails more often than this carries nothing worth having


@dataclass(frozen=True)
class Rates:
    """Choices at one noise level for n positions.

    Attributes:
        snr_db: median over positions of the mean signal-to-noise ratio [dB].
        oracle, chosen: (n,) MCS from the true and from the predicted channel.
        oracle_bps, chosen_bps: (n,) throughput with the transport blocks that arrive [bit/s].
        outage: (n,) bool, the oracle's transport blocks mostly fail.
        backoff_db: subtracted from predicted signal-to-noise ratios before choosing [dB].
    """

    snr_db: float
    oracle: np.ndarray
    chosen: np.ndarray
    oracle_bps: np.ndarray
    chosen_bps: np.ndarray
    outage: np.ndarray
    backoff_db: float


class Adaptation:
    """Sionna's inner loop on effective SINRs (EESM), PUSCH, MCS table 1.

    Args:
        bler_target: of a transport block.
        subcarriers: allocated (paper: 624); tones are repeated to fill them.
        symbols_per_s: OFDM symbols a second (paper: 28,000).
    """

    def __init__(
        self, bler_target: float = 0.1, subcarriers: int = 624, symbols_per_s: float = 28_000
    ) -> None:
        from sionna.phy.nr.utils import decode_mcs_index
        from sionna.sys import InnerLoopLinkAdaptation, PHYAbstraction

        self.abstraction = PHYAbstraction()
        self.loop = InnerLoopLinkAdaptation(self.abstraction, bler_target=bler_target)
        self.subcarriers, self.symbols_per_s = subcarriers, symbols_per_s
        order, rate = decode_mcs_index(torch.arange(28), table_index=1, is_pusch=True)
        self.efficiency = (order.double() * rate.double()).cpu().numpy()

    def rates(self, true: Tensor, predicted: Tensor, noise: float, backoff_db: float = 0.0) -> Rates:
        """Choose on `predicted`, live with `true`: both (n, K) complex, `noise` their noise power."""
        predicted = predicted * 10 ** (-backoff_db / 20)
        oracle, chosen, oracle_fails, chosen_fails = [], [], [], []
        for start in range(0, len(true), CHUNK):
            there, guess = (self._sinr(h[start : start + CHUNK], noise) for h in (true, predicted))
            best, own = self._choice(there), self._choice(guess)
            oracle.append(best)
            chosen.append(own)
            oracle_fails.append(self._fails(best, there))
            chosen_fails.append(self._fails(own, there))
        right, taken = (torch.cat(x).flatten().cpu().numpy().astype(int) for x in (oracle, chosen))
        lost_best, lost_own = (
            torch.cat(x).flatten().cpu().double().numpy() for x in (oracle_fails, chosen_fails)
        )
        full = self.efficiency * self.subcarriers * self.symbols_per_s
        snr = true.abs().square().mean(1) / noise
        return Rates(
            float(10 * snr.median().log10()),
            right,
            taken,
            full[right] * (1 - lost_best),
            full[taken] * (1 - lost_own),
            lost_best > OUTAGE,
            backoff_db,
        )

    def _sinr(self, channel: Tensor, noise: float) -> Tensor:
        """(n, symbols, subcarriers, 1, 1), linear."""
        per_tone = channel.abs().square() / noise
        at = torch.arange(self.subcarriers) * per_tone.shape[1] // self.subcarriers
        return per_tone[:, None, at, None, None].expand(-1, SYMBOLS, -1, 1, 1).contiguous()

    def _choice(self, sinr: Tensor) -> Tensor:
        return self.loop(sinr=sinr, mcs_table_index=1, mcs_category=0)

    def _fails(self, mcs: Tensor, sinr: Tensor) -> Tensor:
        """Transport-block error rate (n, 1)."""
        return self.abstraction(mcs, sinr=sinr, mcs_table_index=1, mcs_category=0)[3]
