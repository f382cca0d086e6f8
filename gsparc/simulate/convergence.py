"""The solver's own error: the same receivers under another seed of its rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

from gsparc.simulate.attribution import Probe
from gsparc.simulate.spectrum import spectra


@dataclass(frozen=True)
class Convergence:
    """Differences between two seeds, over the receivers traced twice.

    Attributes:
        nmse: of the channels, sum |difference|^2 / sum |channel|^2.
        spectrum_nmse, spectrum_mse, spectrum_psnr_db, spectrum_ssim: of the spectra.
        receivers: how many were traced twice.
    """

    nmse: float
    spectrum_nmse: float
    spectrum_mse: float
    spectrum_psnr_db: float
    spectrum_ssim: float
    receivers: int

    def attributes(self) -> dict[str, float | int]:
        """For the file, beside `convergence_error`, which is `nmse`."""
        return {f"convergence_{name}": value for name, value in vars(self).items() if name != "nmse"}


def compare(first: Probe, second: Probe) -> Convergence:
    """How far two runs of the same receivers are apart."""
    channels = [p.paths.responses(p.frequency_hz, p.elements, p.wavelength) for p in (first, second)]
    nmse = float((np.abs(channels[0] - channels[1]) ** 2).sum() / (np.abs(channels[0]) ** 2).sum())
    images = [spectra(p.paths, p.spectrum, p.frequency_hz, p.wavelength)[0] for p in (first, second)]
    squared = ((images[0] - images[1]) ** 2).mean((1, 2))
    similar = [structural_similarity(a, b, data_range=1.0) for a, b in zip(*images, strict=True)]
    return Convergence(
        nmse,
        float(squared.sum() / (images[0] ** 2).mean((1, 2)).sum()),
        float(squared.mean()),
        float(np.mean(-10 * np.log10(np.maximum(squared, 1e-12)))),
        float(np.mean(similar)),
        len(squared),
    )
