"""Modulation and coding from predicted channels, and the throughput that comes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.base.limits import choice
from gsparc.physics.decibels import from_decibels, to_decibels

# 14 symbols of a slot less two of pilots.
SYMBOLS = 12  # of a slot that carry data
# 256 positions x 28 MCS x tones are held by Sionna at once.
CHUNK = 256
RULES = choice("carries_most", "target")  # how an MCS is chosen from a prediction
OUTAGE = 0.5  # a transport block that fails more often than this carries nothing worth having
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(9)  # of a normal law
# d(10 log10 |h|^2) = 20 / ln 10 times the relative error, whose real part has half of its power.
# SINR error [dB] of one flat tone per root of relative error
SLOW_DECIBEL = 20 / np.log(10) / np.sqrt(2)


@dataclass(frozen=True)
class Rates:
    """Choices at one noise level for n positions.

    Attributes:
        snr_db: median over positions that are not silent of the mean signal-to-noise ratio [dB].
        oracle, chosen: (n,) MCS from the true and from the predicted channel.
        oracle_bps, chosen_bps: (n,) throughput with the transport blocks that arrive [bit/s].
        best_bps: (n,) of the MCS that carries most, were the channel known [bit/s].
        fails: (n,) block error rate of the chosen MCS.
        outage: (n,) bool, the oracle's transport blocks mostly fail.
        care: share of `SLOW_DECIBEL` that the choice allowed for; None where it was not asked.
    """

    snr_db: float
    oracle: np.ndarray
    chosen: np.ndarray
    oracle_bps: np.ndarray
    chosen_bps: np.ndarray
    best_bps: np.ndarray
    fails: np.ndarray
    outage: np.ndarray
    care: float | None


@dataclass(frozen=True)
class Band:
    """What is known of one antenna's band at n positions.

    Attributes:
        true, predicted: (n, K) complex.
        variance: (n,) expected squared error per entry; 0 where the method states none.
    """

    true: Tensor
    predicted: Tensor
    variance: Tensor

    @property
    def median_power(self) -> float:
        """Median over the positions that are not silent of the mean power; 0 where all are."""
        power = self.true.abs().square().mean(1)
        return float(power[power > 0].median()) if (power > 0).any() else 0.0

    @property
    def expected_power(self) -> Tensor:
        """E |h|^2 (n, K): a mean that was shrunk by its doubt is no estimate of power."""
        # E|h|^2 = |mean|^2 + variance; |mean|^2 alone would choose too low a rate
        # where doubt is large.
        return self.predicted.abs().square() + self.variance[:, None]


class Adaptation:
    """MCS by effective SINR (EESM) and Sionna's block error tables, PUSCH, MCS table 1.

    The oracle takes the highest MCS whose blocks fail in at most `bler_target`; so does a
    prediction by the rule `target` (the paper). By `carries_most` it takes the MCS that is expected
    to carry most, the effective SINR being normal in dB with a spread that grows
    with the expected error.

    Args:
        bler_target: of a transport block.
        subcarriers: allocated (paper: 624); the tones stand for them evenly.
        symbols_per_s: OFDM symbols a second (paper: 28,000).
    """

    def __init__(
        self, bler_target: float = 0.1, subcarriers: int = 624, symbols_per_s: float = 28e3
    ) -> None:
        from sionna.phy.nr.utils import decode_mcs_index
        from sionna.sys import PHYAbstraction

        self.abstraction = PHYAbstraction()
        self.bler_target = bler_target
        self.subcarriers, self.symbols_per_s = subcarriers, symbols_per_s
        # 28: table 6.1.4.1-1 of TS 38.214, which Sionna takes for PUSCH;
        # 28 to 31 are for retransmissions.
        order, rate = decode_mcs_index(torch.arange(28), table_index=1, is_pusch=True)
        efficiency = (order.double() * rate.double()).cpu()
        self.full_bps = efficiency * subcarriers * symbols_per_s

    def rates(self, band: Band, noise: float, care: float | None) -> Rates:
        """Choose on the prediction, live with the truth; `noise` is the noise power,
        `care` as in `Rates`.

        Without care the rule is `target`.
        """
        there = self._effective_db(band.true.abs().square() / noise)
        guess = self._effective_db(band.expected_power / noise)
        fails = self._fails(there)
        oracle = self._highest(fails)
        if care is None:
            chosen = self._highest(self._fails(guess))
        else:
            # 1e-30 keeps a silent prediction's doubt at its largest, 1, instead of NaN.
            loud = band.expected_power.mean(1).clamp_min(1e-30)
            # Root of the relative error
            doubt = SLOW_DECIBEL * (band.variance / loud).clamp(0, 1).sqrt()
            chosen = self._carries_most(guess, care * doubt)
        # Infinite where there is no such MCS: it carries nothing, as one that always fails.
        delivered = self.full_bps * (1 - fails.clamp_max(1))

        def gathered(table: Tensor, mcs: Tensor) -> np.ndarray:
            return table.gather(1, mcs[:, None])[:, 0].double().numpy()

        return Rates(
            10 * math.log10(band.median_power / noise),
            oracle.numpy(),
            chosen.numpy(),
            gathered(delivered, oracle),
            gathered(delivered, chosen),
            delivered.max(1).values.numpy(),
            gathered(fails.clamp_max(1), chosen),
            gathered(fails, oracle) > OUTAGE,
            care,
        )

    def _effective_db(self, sinr: Tensor) -> Tensor:
        """Effective SINR [dB] (n, 28) under every MCS, from the SINR of the tones (n, K)."""
        tones = sinr[:, None, None, :, None, None].expand(-1, 28, 1, -1, 1, 1)
        return to_decibels(self._of_every_mcs(2, sinr=tones))

    def _fails(self, effective_db: Tensor) -> Tensor:
        """Transport-block error rates (n, 28); infinite where there is no such MCS."""
        allocated = torch.full(
            (len(effective_db), 28, 1), SYMBOLS * self.subcarriers, dtype=torch.int32
        )
        effective = from_decibels(effective_db)[..., None]
        return self._of_every_mcs(3, sinr_eff=effective, num_allocated_re=allocated).double()

    def _highest(self, fails: Tensor) -> Tensor:
        """The highest MCS (n,) that meets the target; the lowest there is where none does."""
        number = torch.arange(28)
        good = torch.where(fails <= self.bler_target, number, -1).max(1).values
        # Tables leave out some MCS: the lowest index there is need not be 0.
        lowest = torch.where(fails.isfinite(), number, 28).min(1).values
        return torch.where(good >= 0, good, lowest)

    def _carries_most(self, effective_db: Tensor, spread_db: Tensor) -> Tensor:
        """The MCS (n,) of the largest expected throughput; of equal ones, as where all fail,
        the lowest.
        """
        carried = torch.zeros(effective_db.shape, dtype=torch.float64)
        # Gauss-Hermite with 9 nodes is exact for polynomials to degree 17 under a normal density.
        for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum(), strict=True):
            fails = self._fails(effective_db + node * spread_db[:, None])
            carried += weight * self.full_bps * (1 - fails.clamp_max(1))
        lowest = torch.where(fails.isfinite(), torch.arange(28), 28).min(1).values
        best = carried.max(1)
        return torch.where(best.values > 0, best.indices, lowest)

    def _of_every_mcs(self, answer: int, **arguments: Tensor) -> Tensor:
        """One of Sionna's answers (n, 28) for every MCS of the table at n positions."""
        # Sionna copies the tones, and grids of tables, for every MCS: parts bound the memory.
        parts = []
        for some in zip(*(values.split(CHUNK) for values in arguments.values()), strict=True):
            said = self.abstraction(
                torch.arange(28, dtype=torch.int32)[None, :, None].expand(len(some[0]), -1, -1),
                **dict(zip(arguments, some, strict=True)),
                mcs_table_index=1,
                mcs_category=0,
                check_mcs_index_validity=False,
            )
            parts.append(said[answer][..., 0].cpu())
        return torch.cat(parts)
