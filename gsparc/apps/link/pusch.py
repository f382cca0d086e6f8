"""5G NR PUSCH with several kinds of channel knowledge, every block the same for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd
import torch
from scipy.linalg import toeplitz
from torch import Tensor

from gsparc.apps.link.adaptation import Band
from gsparc.base.limits import choice

Prior = Callable[[], tuple[Tensor, Tensor] | None]
Estimator = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
LEAST_VARIANCE = 1e-6  # of a channel's power: pilots always correct a little
NEEDED = "perfect", "predicted"  # receivers that the others are judged beside
RECEIVERS = choice(*NEEDED, "ls", "lmmse", "predicted_pilots")
MODULATIONS = {"qpsk": 5, "qam16": 14}  # MCS of table 1: rates 0.37 and 0.54


class Pusch:
    """One user, one layer, one receive antenna; two DMRS symbols a slot.

    Args:
        modulation: `qpsk` or `qam16`.
        blocks: resource blocks of 12 subcarriers.
        spacing_khz: subcarrier spacing [kHz].
        correlation: frequency correlation at multiples of the subcarrier spacing (12 blocks,)
            complex, from training channels; the LMMSE estimator's knowledge.
        iterations: of the LDPC decoder.
        names: of the receivers, see `RECEIVERS`.
    """

    def __init__(
        self,
        modulation: str,
        blocks: int,
        spacing_khz: int,
        correlation: np.ndarray,
        iterations: int = 20,
        names: Sequence[str] = ("perfect", "lmmse", "predicted", "predicted_pilots"),
    ) -> None:
        from sionna.phy import nr

        config = nr.PUSCHConfig()
        config.carrier.n_size_grid = blocks
        config.carrier.subcarrier_spacing = spacing_khz
        config.tb.mcs_table = 1
        config.tb.mcs_index = MODULATIONS[modulation]
        # A second symbol of pilots a slot: both are averaged against noise.
        config.dmrs.additional_position = 1
        self.transmitter = nr.PUSCHTransmitter(config)
        self.grid = self.transmitter.resource_grid
        self.bits, self.rate = int(config.tb.num_bits_per_symbol), float(config.tb.target_coderate)
        self._known: dict[str, tuple[Tensor, Tensor]] = {}
        self._prior: tuple[Tensor, Tensor] | None = None
        estimators: dict[str, Estimator] = {
            "perfect": lambda y, no: self._known["perfect"],
            "ls": nr.PUSCHLSChannelEstimator(
                self.grid,
                config.dmrs.length,
                config.dmrs.additional_position,
                config.dmrs.num_cdm_groups_without_data,
                interpolation_type="lin",
            ),
            "lmmse": _Wiener(self.grid, correlation),
            "predicted": lambda y, no: self._known["predicted"],
            "predicted_pilots": _Wiener(self.grid, correlation, lambda: self._prior),
        }
        decoder = nr.TBDecoder(self.transmitter._tb_encoder, num_bp_iter=iterations)
        factory = partial(
            nr.PUSCHReceiver, self.transmitter, tb_decoder=decoder, return_tb_crc_status=True
        )
        self.receivers = {name: factory(channel_estimator=estimators[name]) for name in names}

    @property
    def pilot_share(self) -> float:
        """Share of a slot's resource elements that pilots occupy."""
        return float(self.grid.num_pilot_symbols) / float(self.grid.num_resource_elements)

    def run(self, band: Band, ebno_db: float, position: np.ndarray, batch: int) -> pd.DataFrame:
        """Send a block over each of `position` (n,), indices into the band.

        Returns:
            A row per block and receiver: `ebno_db` [dB], `position`, `receiver`, `failed` (whether
            the transport block's checksum was wrong) and `wrong` (share of wrong bits).
        """
        from sionna.phy.channel import ApplyOFDMChannel
        from sionna.phy.utils import ebnodb2no

        no = ebnodb2no(ebno_db, self.bits, self.rate, self.grid)
        apply, parts = ApplyOFDMChannel(add_awgn=True), []
        for start in range(0, len(position), batch):
            rows = position[start : start + batch]
            at = torch.from_numpy(rows)
            # Each channel to mean power 1: Eb/N0 is then that of every block,
            # not of the median place.
            scale = band.true[at].abs().square().mean(1).sqrt()[:, None]
            self._prior = band.predicted[at] / scale, band.variance[at] / scale[:, 0] ** 2
            there, guess = (self._slots(h[at] / scale) for h in (band.true, band.predicted))
            # Variance 0: what is taken for exact is trusted fully.
            self._known = {"perfect": (there, torch.zeros(1)), "predicted": (guess, torch.zeros(1))}
            sent, bits = self.transmitter(len(at))
            received = apply(sent, there, no)
            for name, receiver in self.receivers.items():
                decoded, fine = receiver(received, no)
                failed = ~fine.bool().flatten().cpu().numpy()
                wrong = (decoded != bits).double().mean(-1).flatten().cpu().numpy()
                columns = {"position": rows, "receiver": name, "failed": failed, "wrong": wrong}
                parts.append(pd.DataFrame({"ebno_db": ebno_db, **columns}))
        return pd.concat(parts, ignore_index=True)

    def _slots(self, channel: Tensor) -> Tensor:
        """(n, K) as [n, rx 1, rx_ant 1, tx 1, tx_ant 1, 14, K]."""
        count = self.grid.num_ofdm_symbols
        return (
            channel[:, None, None, None, None, None, :]
            .expand(-1, 1, 1, 1, 1, count, -1)
            .contiguous()
        )


class _Wiener:
    """LMMSE interpolation of one layer's DMRS over frequency; symbols of a slot are averaged.

    With a `prior`, means (n, K) and variances (n,) of the channels, pilots correct the prediction:
    what they tell of its error is spread over frequency as channels are correlated. Without, the
    mean is 0 and the variance 1.
    """

    def __init__(self, grid, correlation: np.ndarray, prior: Prior | None = None) -> None:
        pattern = grid.pilot_pattern
        mask = pattern.mask[0, 0].bool().cpu()
        full = torch.zeros(mask.shape, dtype=torch.complex64)
        full[mask] = pattern.pilots[0, 0].to(torch.complex64).cpu()
        self.symbols = mask.any(1).nonzero().flatten()
        self.comb = (full[self.symbols[0]].abs() > 0).nonzero().flatten()
        self.pilots = full[self.symbols][:, self.comb]
        # R(-k) = conj R(k): the correlation matrix is Hermitian, and Toeplitz.
        self.whole = torch.from_numpy(toeplitz(correlation[: mask.shape[1]])).to(torch.complex128)
        self.prior = prior

    def __call__(self, y: Tensor, no: Tensor) -> tuple[Tensor, Tensor]:
        heard = y[:, 0, 0][:, self.symbols][:, :, self.comb]
        # Pilots of both symbols are averaged: the channel stands still over a slot.
        energy = self.pilots.abs().square().sum(0)
        matched = (heard * self.pilots.conj()).sum(1) / energy
        noise = float(torch.as_tensor(no).flatten()[0]) / energy.double()
        prior = None if self.prior is None else self.prior()
        mean, variance = (
            (torch.zeros(1, self.whole.shape[0]), torch.ones(1)) if prior is None else prior
        )
        variance = variance.double().clamp_min(LEAST_VARIANCE)[:, None]
        # In units of the prior variance: R_c (R_cc + N / v)^-1,
        # a matrix for each position with its own.
        doubt = torch.diag_embed((noise / variance).to(self.whole.dtype))
        gram = self.whole[self.comb][:, self.comb] + doubt
        cross = self.whole[:, self.comb]
        filtering = torch.linalg.solve(gram.mT, cross.T.expand(len(gram), -1, -1)).mT
        news = (matched - mean[:, self.comb]).to(filtering.dtype)
        smooth = mean + (filtering @ news[..., None])[..., 0].to(torch.complex64)
        # The error's variance, v (R - F C^H), which rounding may take below 0.
        residual = (
            torch.diagonal(self.whole).real - (filtering * cross.conj()).sum(-1).real
        ).clamp_min(0)
        shape = (len(y), 1, 1, 1, 1, y.shape[3], y.shape[4])
        spread = (variance * residual).float().view(-1, 1, 1, 1, 1, 1, self.whole.shape[0])
        estimate = smooth.view(len(y), 1, 1, 1, 1, 1, -1).expand(shape).contiguous()
        return estimate, spread.expand(shape).contiguous()


def frequency_correlation(
    channel: Tensor, tones_hz: np.ndarray, spacing_hz: float, count: int
) -> np.ndarray:
    """Return the normalised correlation over frequency at lags 0 to count - 1 of `spacing_hz`,
    from channels (n, K).
    """
    if len(tones_hz) == 1:
        return np.ones(count, complex)
    # Each channel to power 1, so that strong places do not decide the correlation.
    unit = (channel / channel.abs().square().mean(1, keepdim=True).sqrt().clamp_min(1e-30)).numpy()
    lags = np.arange(len(tones_hz))
    values = np.array(
        [(unit[:, lag:] * unit[:, : len(tones_hz) - lag].conj()).mean() for lag in lags]
    )
    step = float(np.diff(np.sort(tones_hz)).min())
    # By lag 0, where `values` is 1 up to rounding and masked tones.
    return np.interp(np.arange(count) * spacing_hz, lags * step, values) / values[0].real
