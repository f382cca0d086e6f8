"""Tapped delay lines along a trajectory: a model's channels as taps at whole samples,
and their Doppler.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.schema import LIGHT
from gsparc.physics.decibels import to_decibels
from gsparc.prediction.predictor import Predictor
from gsparc.tables.raw import Raw, write_raw

PER_WAVE = 8  # instants per wavelength of the fastest motion: four times what its Doppler needs
MOST = 50_000  # instants
CHUNK = 64  # places that the model answers at once
FITTED = 512  # channels that tell where most power arrives
RIDGE = 1e-4  # of a tap's energy over the tones: what the band does not hold stays small


@dataclass(frozen=True)
class Trajectory:
    """Where the moving end is when, in straight lines between rows.

    Attributes:
        time_s: (n,) float64 [s], rising.
        place: (n, 3) float64 [m, world].
    """

    time_s: np.ndarray
    place: np.ndarray

    def __post_init__(self) -> None:
        if len(self.time_s) < 2 or (np.diff(self.time_s) <= 0).any():
            raise ValueError(
                "a trajectory needs two rows or more, each later than the one before (time_s)"
            )

    def places_at(self, time_s: np.ndarray) -> np.ndarray:
        """Return places (m, 3) at times (m,)."""
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in self.place.T], 1)

    def instants(self, wavelength: float) -> np.ndarray:
        """Return times (T,), a part of a wavelength apart, at which a channel is to be known.

        Four or more.
        """
        fastest = float(
            (np.linalg.norm(np.diff(self.place, axis=0), axis=1) / np.diff(self.time_s)).max()
        )
        # Were it always that fast
        longest = float(self.time_s[-1] - self.time_s[0]) * fastest / wavelength
        # Four at least: a cubic spline needs them.
        count = max(int(np.ceil(longest * PER_WAVE)) + 1, 4)
        if count > MOST:
            far = f"the trajectory is {longest:.0f} wavelengths long"
            raise ValueError(
                f"{far}, at most {MOST // PER_WAVE} are exported at once; take a part of it"
            )
        return np.linspace(self.time_s[0], self.time_s[-1], count)


@dataclass(frozen=True)
class TappedDelayLine:
    """Taps at instants so close that those between can be interpolated.

    The channel at f is the sum over l of
    `gain exp(-j 2 pi (f - carrier_hz) (first + l) / rate_hz)`.

    Attributes:
        time_s: (T,) float64 [s].
        gain: (T, A, L) complex64, physical units.
        first: delay of the first tap [samples].
        rate_hz, carrier_hz: of the samples, and the middle of the band [Hz].
        residual: mean square that taps leave of the model's channels over the band, of these.
        worst: the same of the worst instant.
    """

    time_s: np.ndarray
    gain: np.ndarray
    first: int
    rate_hz: float
    carrier_hz: float
    residual: float
    worst: float

    def doppler_hz(self) -> np.ndarray:
        """Return the mean Doppler shift (A, L) float64 [Hz] of each tap:
        the phase it gains from instant to instant.
        """
        # The mean of products weighs each step by its power: a fade's phase is noise.
        turned = (self.gain[1:] * self.gain[:-1].conj()).sum(0, dtype=np.complex128)
        return np.angle(turned) / (2 * np.pi * (self.time_s[1] - self.time_s[0]))


def write_taps(
    predictor: Predictor, way: Trajectory, how: Mapping[str, Any], file: Path
) -> dict[str, Any]:
    """Write taps, delays and Doppler to `file`, an npz.

    Args:
        predictor: of channels with one end that stands still.
        way: of the other end.
        how: see conf/export.yaml.
        file: path of the npz.

    Returns:
        Facts: `taps/*`; decibels of what taps leave of the channels.
    """
    site = predictor.site
    line = fit_taps(predictor, way, how["taps"], how["rate_hz"], how["antennas"])
    units = {"time_s": "s", f"{site.moving_end}_position": "m", "delay_s": "s", "doppler_hz": "Hz"}
    delay_s = (line.first + np.arange(line.gain.shape[2])) / line.rate_hz
    axes = (line.time_s, way.places_at(line.time_s), delay_s, line.doppler_hz())
    arrays = dict(zip(units, axes, strict=True)) | {"gain": line.gain}
    about = {"rate_hz": line.rate_hz, "carrier_hz": line.carrier_hz, "residual": line.residual}
    write_raw(file, Raw(arrays, about, units))
    # 1e-30 is -300 dB: no residual at all has no decibels.
    error_db, worst = to_decibels(np.maximum([line.residual, line.worst], 1e-30))
    return {
        "taps/count": line.gain.shape[2],
        "taps/rate_hz": line.rate_hz,
        "taps/residual_db": float(error_db),
        "taps/worst_db": float(worst),
        "taps/early_s": delay_s[0],
    }


def fit_taps(
    predictor: Predictor,
    way: Trajectory,
    taps: int,
    rate_hz: float | None = None,
    antennas: int = 1,
) -> TappedDelayLine:
    """Fit taps of a model's channels along a trajectory, by least squares over the band.

    Over the measured tones. The taps stand side by side, where most power arrives.

    Args:
        predictor, way: of channels with one end that stands still, and of the other end.
        taps: L; never more than the tones.
        rate_hz: of samples; None: tones times their spacing.
        antennas: A, the first of the array's.

    Raises:
        ValueError: another model, no rate, a band wider than the rate, or silence.
    """
    site = predictor.site
    if not site.target.is_complex or site.paired:
        raise ValueError("to=taps: channels with one end that stands still are needed")
    tones = site.tones()
    if rate_hz is None and len(tones) == 1:
        raise ValueError(f"rate_hz= is needed: {site.name} was measured at one frequency")
    # The band where all tones are in use; with gaps it is too narrow, which is refused below.
    rate_hz, carrier = (
        rate_hz or float(np.diff(np.sort(tones)).min() * len(tones)),
        float(tones.mean()),
    )
    time_s = way.instants(LIGHT / carrier)
    places = way.places_at(time_s)

    def ask(place: np.ndarray) -> np.ndarray:
        where: dict[str, Any] = site.name_moving(place)
        answer = predictor.csi(**where)
        measured = ~np.isnan(answer)  # constant antennas and tones have no channel, and no taps
        return answer[:, measured.any((0, 2))][:, :antennas, measured.any((0, 1))]

    if np.ptp(tones) > rate_hz:
        raise ValueError(
            f"rate_hz={rate_hz:g}: the tones span {np.ptp(tones) / 1e6:g} MHz; give more"
        )
    # No more taps than equations, of which each tone is one.
    taps, turns = min(taps, len(tones)), (tones - carrier) / rate_hz
    first = _first(ask(places[:: max(len(places) // CHUNK, 1)][:CHUNK]), turns, taps)
    columns, solve = _atoms(turns, first, taps)
    gains, errors, power = [], [], []
    for start in range(0, len(places), CHUNK):
        channel = ask(places[start : start + CHUNK])
        gains.append((channel @ solve.T).astype(np.complex64))
        errors.append(np.square(np.abs(gains[-1] @ columns.T - channel)).sum((1, 2)))
        power.append(np.square(np.abs(channel)).sum((1, 2)))
    error, total = np.concatenate(errors), np.concatenate(power)
    if not total.all():
        at = places[int(np.argmin(total))].round(2).tolist()
        raise ValueError(f"the model predicts no power at {at} m, far from every measurement")
    return TappedDelayLine(
        time_s,
        np.concatenate(gains),
        first,
        rate_hz,
        carrier,
        float(error.sum() / total.sum()),
        float((error / total).max()),
    )


def _atoms(turns: np.ndarray, first: int, taps: int) -> tuple[np.ndarray, np.ndarray]:
    """Taps to tones (K, L), and tones to taps (L, K), at tones (K,) in turns per sample."""
    columns = np.exp(-2j * np.pi * turns[:, None] * (first + np.arange(taps)))
    gram = columns.conj().T @ columns + RIDGE * len(turns) * np.eye(taps)
    return columns, np.linalg.solve(gram, columns.conj().T)


def _first(channel: np.ndarray, turns: np.ndarray, taps: int) -> int:
    """Delay [samples] from which taps hold most of channels (B, A, K);
    below 0 where that is nearer.
    """
    rows = channel.reshape(-1, channel.shape[-1])[:FITTED]
    if len(turns) == 1:
        return 0
    # Then delays come again
    period = int(np.clip(round(1 / np.diff(np.sort(turns)).min()), taps, 8192))
    profile = np.square(np.abs(rows @ np.exp(2j * np.pi * turns[:, None] * np.arange(period)))).sum(
        0
    )
    energy = np.convolve(
        np.concatenate([profile, profile])[: period + taps - 1], np.ones(taps), "valid"
    )
    middle = int(energy.argmax())

    def residual(first: int) -> float:
        columns, solve = _atoms(turns, first, taps)
        return float(np.square(np.abs(rows @ solve.T @ columns.T - rows)).sum())

    # The profile's maximum is within a few samples of the best, which least squares then decides.
    best = min(range(middle - 4, middle + 5), key=residual)
    # In the second half of the period a delay is nearer as a negative one.
    return best if best < period / 2 or period <= taps else best - period
