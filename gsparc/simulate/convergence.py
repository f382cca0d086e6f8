"""The solver's own error: the same receivers under another seed of its rays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

from gsparc.physics.decibels import to_decibels
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.spectrum import render_spectra
from gsparc.simulate.survey import Survey

CHECKED = 0.25  # largest share of the rows that is traced again


@dataclass(frozen=True)
class Convergence:
    """Differences between two seeds, over the receivers traced twice.

    Attributes:
        nmse: of the channels, sum |difference|^2 / sum |channel|^2.
        spectrum_nmse, spectrum_psnr_db, spectrum_ssim: of the spectra.
        power_db: 95th percentile of |difference| of the received power, of receivers that both
            reach [dB].
        receivers: how many were traced twice.
    """

    nmse: float
    spectrum_nmse: float
    spectrum_psnr_db: float
    spectrum_ssim: float
    power_db: float
    receivers: int

    def attributes(self) -> dict[str, float | int]:
        """Return attributes for the file, beside `convergence_error`, which is `nmse`."""
        return {
            f"convergence_{name}": value for name, value in vars(self).items() if name != "nmse"
        }


def measure_convergence(
    campaign: CampaignSettings,
    survey: Survey,
    traced: Mapping[str, np.ndarray],
    left_out: np.ndarray,
) -> Convergence | None:
    """Compare rows of a file with a second seed's; None where none is asked for, or without rays.

    Args:
        campaign, survey: of the file.
        traced: its arrays, a row for each of the survey's.
        left_out: (n,) rows that were traced otherwise.
    """
    count = min(campaign.check, int(CHECKED * len(survey)))
    if count == 0 or not survey.engine.random:
        return None
    # So many that enough remain when those traced otherwise are taken out.
    rows = survey.choose_distant_rows(count + len(left_out), campaign.scene.seed + 1)
    rows = np.sort(rows[~np.isin(rows, left_out)][:count])
    again = survey.trace(rows, campaign.decided, campaign.sampling.seed + 1)
    csi, spectrum, power = (traced[name][rows] for name in ("csi", "spectrum", "received_power"))
    frequency, wavelength = campaign.scene.frequency_hz, survey.engine.wavelength
    other = again.responses(frequency, campaign.csi.elements(wavelength), wavelength)
    energy = max(float((np.abs(csi) ** 2).sum()), np.finfo(float).tiny)
    images = [spectrum / 255, render_spectra(again, campaign.spectrum, frequency, wavelength)[0]]
    squared = ((images[0] - images[1]) ** 2).mean((1, 2))
    similar = [structural_similarity(a, b, data_range=1.0) for a, b in zip(*images, strict=True)]
    twice = np.stack([power, again.received_power()])
    # Only receivers that both seeds reach have levels to compare.
    difference_db = np.abs(np.diff(to_decibels(twice[:, (twice > 0).all(0)]), axis=0))
    return Convergence(
        nmse=float((np.abs(csi - other) ** 2).sum() / energy),
        spectrum_nmse=float(squared.sum() / (images[0] ** 2).mean((1, 2)).sum()),
        spectrum_psnr_db=-float(np.mean(to_decibels(np.maximum(squared, 1e-12)))),
        spectrum_ssim=float(np.mean(similar)),
        power_db=float(np.quantile(difference_db, 0.95)) if difference_db.size else 0.0,
        receivers=len(squared),
    )
