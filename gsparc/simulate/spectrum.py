"""Definition of a simulated spectrum, stored with the data.

Bartlett: the elements of a stated planar array receive the paths from above their ground plane on
every subcarrier, `P(u) = mean_k |a(u)^H h_k|^2 / M^2`, the subcarriers being the snapshots;
interference within the band is real.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch

from gsparc.base.limits import POSITIVE, Checked, setting, whole
from gsparc.ops import SphereGrid
from gsparc.simulate.paths import TracedPaths

BLOCK = 64  # receivers at once


@dataclass(frozen=True)
class ArraySettings(Checked):
    """A planar array in the receiver's xy plane.

    Attributes:
        rows, columns: elements; 1 x 1 is one antenna at the receiver's place.
        spacing: in carrier wavelengths.
    """

    rows: int = setting(1, whole(1))
    columns: int = setting(1, whole(1))
    spacing: float = setting(0.5, POSITIVE)

    def elements(self, wavelength: float) -> np.ndarray:
        """Return positions (M, 3) [m] of the elements about their middle.

        >>> ArraySettings(rows=2, columns=1).elements(wavelength=0.1)[:, 0].tolist()
        [-0.025, 0.025]
        """
        x, y = (
            (np.arange(n) - (n - 1) / 2) * self.spacing * wavelength
            for n in (self.rows, self.columns)
        )
        return np.stack(np.meshgrid(x, y, 0.0, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class SpectrumSettings(ArraySettings):
    """One definition of a spectrum, of an array; a pixel is an amplitude.

    Attributes:
        height, width: pixels; row i is i x 90/height degrees of elevation, column j j x 360/width
            of azimuth.
    """

    rows: int = setting(8, whole(1))
    columns: int = setting(8, whole(1))
    height: int = setting(90, whole(1))
    width: int = setting(360, whole(1))

    @property
    def grid(self) -> SphereGrid:
        """Directions of the pixels: the upper hemisphere."""
        return SphereGrid.hemisphere(self.height, self.width)

    def attributes(self) -> dict[str, str | float | int]:
        """Return the definition as attributes of a file."""
        settings = {f"spectrum_{key}": value for key, value in asdict(self).items()}
        return {"normalisation": "max", "spectrum_scale": "amplitude", **settings}


def render_spectra(
    paths: TracedPaths, settings: SpectrumSettings, frequency_hz: np.ndarray, wavelength: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return spectra (R, H, W) float32, and the largest amplitude of each (R,),
    which it was divided by.

    Only paths from above the horizon are received; world axes are the receivers'. A receiver
    without any is black, divided by 1. The subcarriers (K,)
    [Hz] are the snapshots of the Bartlett spectrum.
    """
    above = paths.select_paths(paths.direction[:, 2] >= 0)
    images = np.empty((len(paths), settings.height, settings.width), dtype=np.float32)
    elements = settings.elements(wavelength)
    bartlett = _Bartlett(settings)
    for start in range(0, len(paths), BLOCK):
        rows = slice(start, start + BLOCK)
        some = above.select_receivers(np.arange(len(paths))[rows])
        channels = some.responses(frequency_hz, elements, wavelength)
        images[rows] = bartlett(channels.reshape(len(some), -1, len(elements), len(frequency_hz)))
    np.sqrt(images, out=images)
    peak = images.max(axis=(1, 2))
    peak = np.where(peak > 0, peak, 1.0).astype(np.float64)
    images /= peak[:, None, None].astype(np.float32)
    return images, peak


class _Bartlett:
    """The spectrum of a planar lattice from its lags: (2 rows - 1)(2 columns - 1)
    real numbers per image.

    `a^H R a` depends on R only through sums over equal element differences, which are the
    autocorrelation of the channel over the lattice:
    one small product instead of M^2 terms per pixel.
    """

    def __init__(self, settings: SpectrumSettings) -> None:
        self.shape = (settings.rows, settings.columns)
        self.padded = tuple(2 * n for n in self.shape)
        lag = [np.fft.fftfreq(2 * n, 1 / (2 * n)) for n in self.shape]
        directions = settings.grid.directions().numpy().reshape(-1, 3)
        # +lag and -lag are conjugates: half of them is enough, counted twice
        x, y = (v.ravel() for v in np.meshgrid(*lag, indexing="ij"))
        self.half = np.flatnonzero((x > 0) | ((x == 0) & (y >= 0)))
        x, y = x[self.half], y[self.half]
        twice = np.where((x == 0) & (y == 0), 1.0, 2.0)
        cycles = settings.spacing * (np.outer(x, directions[:, 0]) + np.outer(y, directions[:, 1]))
        angle = 2 * np.pi * cycles
        basis = np.concatenate([twice[:, None] * np.cos(angle), twice[:, None] * np.sin(angle)])
        self.basis = torch.from_numpy(basis.astype(np.float32))
        self.image = (settings.height, settings.width)

    def __call__(self, channels: np.ndarray) -> np.ndarray:
        """Power (R, H, W) of channels (R, ports, M, K)."""
        lattice = np.moveaxis(channels, 2, -1).reshape(
            *channels.shape[:2], channels.shape[3], *self.shape
        )
        # Padded to twice the size, so that the circular autocorrelation is the one of the lattice.
        power = np.abs(np.fft.fft2(lattice, s=self.padded)) ** 2
        lags = np.fft.ifft2(power.mean(axis=2).sum(axis=1)).reshape(len(channels), -1)[:, self.half]
        lags = lags / np.prod(self.shape) ** 2
        # a^H h h^H a with a = exp(+j k u.e): element differences enter with the opposite sign
        parts = np.concatenate([lags.real, lags.imag], axis=1)
        image = torch.from_numpy(parts.astype(np.float32)) @ self.basis
        return image.clamp_(min=0).numpy().reshape(-1, *self.image)
