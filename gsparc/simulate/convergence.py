"""The solver's own error: the same receivers under another seed of its rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

from gsparc.simulate.paths import Paths
from gsparc.simulate.settings import Campaign
from gsparc.simulate.spectrum import spectra


@dataclass(frozen=True)
class Convergence:
    """Differences between two seeds, over the receivers traced twice.

    Attributes:
        nmse: of the channels, sum |difference|^2 / sum |channel|^2.
        spectrum_nmse, spectrum_mse, spectrum_psnr_db, spectrum_ssim: of the spectra.
        power_db: 95th percentile of |difference| of the received power, of receivers that both reach [dB].
        receivers: how many were traced twice.
    """

    nmse: float
    spectrum_nmse: float
    spectrum_mse: float
    spectrum_psnr_db: float
    spectrum_ssim: float
    power_db: float
    receivers: int

    def attributes(self) -> dict[str, float | int]:
        """For the file, beside `convergence_error`, which is `nmse`."""
        return {f"convergence_{name}": value for name, value in vars(self).items() if name != "nmse"}


def compare(
    csi: np.ndarray,
    spectrum: np.ndarray,
    peak: np.ndarray,
    power: np.ndarray,
    again: Paths,
    campaign: Campaign,
    wavelength: float,
) -> Convergence:
    """How far receivers of a file are from the same under another seed.

    Args:
        csi: (n, A, K) of the file, without noise.
        spectrum, peak, power: (n, H, W) uint8, (n,) and (n,) of the file.
        again: the same receivers traced again.
        campaign: band, arrays and spectra.
        wavelength: at the carrier [m].
    """
    frequency = campaign.scene.frequency_hz
    other = again.responses(frequency, campaign.csi.elements(wavelength), wavelength)
    energy = max(float((np.abs(csi) ** 2).sum()), np.finfo(float).tiny)
    nmse = float((np.abs(csi - other) ** 2).sum() / energy)
    # Each image by its own largest value, or all by the largest of these receivers.
    share = 1.0 if campaign.spectrum.normalisation == "max" else (peak / peak.max())[:, None, None]
    images = [spectrum / 255 * share, spectra(again, campaign.spectrum, frequency, wavelength)[0]]
    squared = ((images[0] - images[1]) ** 2).mean((1, 2))
    similar = [structural_similarity(a, b, data_range=1.0) for a, b in zip(*images, strict=True)]
    twice = np.stack([power, again.received_power()])
    twice = twice[:, (twice > 0).all(0)]
    apart = np.abs(np.diff(10 * np.log10(twice), axis=0))
    return Convergence(
        nmse,
        float(squared.sum() / (images[0] ** 2).mean((1, 2)).sum()),
        float(squared.mean()),
        float(np.mean(-10 * np.log10(np.maximum(squared, 1e-12)))),
        float(np.mean(similar)),
        float(np.quantile(apart, 0.95)) if apart.size else 0.0,
        len(squared),
    )
