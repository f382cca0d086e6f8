"""What levels of several stations say of a square: who serves, over what, whether anybody does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from gsparc.apps.maps.intervals import IntervalScales
from gsparc.base.errors import DataError
from gsparc.base.limits import finite_array
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.processes.uncertainty import half_width

REFUSED = -1  # of `best_server`
OVERLAP_DB = 6.0  # below the strongest, where another disturbs and hands over
# Quantiles of the strongest that rivals are weighed against
SHARES = ((np.arange(16) + 0.5) / 16)[:, None]


def best_server(power_db: np.ndarray) -> np.ndarray:
    """Number of the strongest of (T, n) powers [dB], (n,) int16; `REFUSED` where none is known."""
    finite = np.isfinite(power_db)
    # -inf, since argmax takes the first NaN for the largest.
    number = np.where(finite, power_db, -np.inf).argmax(axis=0)
    return np.where(finite.any(axis=0), number, REFUSED).astype(np.int16)


def server_chance(
    power_db: np.ndarray,
    error_db: np.ndarray,
    floor_db: np.ndarray,
    alike: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the probability (n,) that the strongest of (T, n) powers is,
    and lies above its station's floor.

    Errors are taken for normal. Given the strongest's own level its rivals are taken for
    independent: who beats one station is likelier to beat another,
    and the product of all chances alone is far too small.

    Args:
        power_db, error_db: predicted, and expected errors; NaN where unknown, which counts as
            weaker: far from where a station was measured it is some 25 dB below its usual level.
        floor_db: (T,) power below which a station is not told from noise; -inf: any is.
        alike: (T, n) correlations of errors with the strongest's: sectors of a site share its
            shadowing.

    Returns:
        NaN where no power is known.
    """
    known, first, cell = _strongest(power_db)
    mean, spread = power_db[first, cell], error_db[first, cell]
    above = heard_chance(power_db, error_db, floor_db)
    z = ndtri(1 - np.maximum(above, 1e-12) * SHARES)  # equally likely levels above the floor
    beaten = _chance_all_below(mean + spread * z, power_db, error_db, alike, z, first)
    return np.where(known, above * beaten, np.nan).astype(np.float32)


def heard_chance(power_db: np.ndarray, error_db: np.ndarray, floor_db: np.ndarray) -> np.ndarray:
    """Return the probability (n,) that the strongest of (T, n) powers lies above its station's
    floor, see `server_chance`; NaN where no power is known.
    """
    _, first, cell = _strongest(power_db)
    return ndtr((power_db[first, cell] - floor_db[first]) / error_db[first, cell])


def _strongest(power_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a power of (T, n) is known in each cell (n,), the strongest's number there,
    and the cell's.
    """
    number = best_server(power_db)
    return number != REFUSED, np.maximum(number, 0), np.arange(power_db.shape[1])


def outage_probability(
    power_db: np.ndarray,
    error_db: np.ndarray,
    threshold_db: float,
    alike: np.ndarray,
    below: np.ndarray,
) -> np.ndarray:
    """Return the probability (n,) that all of (T, n) powers lie below a threshold:
    who misses one may hear another.

    Errors are normal; given the strongest's level its rivals are independent, and what is unknown
    counts as below, as in `server_chance`.

    Args:
        power_db, error_db, alike: see `server_chance`.
        threshold_db: in the unit of the powers.
        below: (n,) probability that the strongest lies below it.
    """
    z = ndtri(np.clip(below, 1e-12, 1) * SHARES)  # equally likely levels of the strongest below it
    limit, first = np.full(z.shape, threshold_db), np.maximum(best_server(power_db), 0)
    return (below * _chance_all_below(limit, power_db, error_db, alike, z, first)).astype(
        np.float32
    )


def _chance_all_below(
    limit: np.ndarray,
    rival: np.ndarray,
    wrong: np.ndarray,
    alike: np.ndarray | float,
    z: np.ndarray,
    first: np.ndarray,
) -> np.ndarray:
    """Chance (n,) that all of (T, n) rivals lie below limits (K, n),
    mean over K normal errors of `first`.

    Unknown ones do.
    """
    # Of a rival given the strongest: never 0, which would divide.
    spread, total, cell = (
        wrong * np.sqrt(np.maximum(1 - np.square(alike), 1e-6)),
        0.0,
        np.arange(len(first)),
    )
    for level, error in zip(limit, z, strict=True):
        below = ndtr((level - rival - alike * wrong * error) / spread)
        below[first, cell] = 1.0
        total = total + np.nan_to_num(below, nan=1.0).prod(axis=0)
    return np.asarray(total / len(z))


def sinr(
    power_db: np.ndarray,
    load: np.ndarray,
    noise_db: float | None,
    carrier: np.ndarray | None = None,
) -> np.ndarray:
    """Signal over interference and noise (n,) [dB] of the strongest of (T, n) powers,
    within its carrier.

    Args:
        power_db: NaN where unknown: such a station is taken for silent.
        load: (T,) share of the time that each transmits while another serves.
        noise_db: power of the noise, in the unit of the powers; None: interference alone.
        carrier: (T,) int64; None: all transmit on one.

    Returns:
        NaN where no power is known, or where there is neither noise nor interference.
    """
    # float64: 10^(-12) beside 10^(-4) keeps no digit of interference in float32.
    linear = np.where(np.isfinite(power_db), from_decibels(power_db.astype(np.float64)), 0.0)
    known, first, cell = _strongest(power_db)
    signal = linear[first, cell]
    same = True if carrier is None else carrier[:, None] == carrier[first]
    received = load @ (linear * same) - load[first] * signal
    noise = 0.0 if noise_db is None else from_decibels(noise_db)
    # The sum less its own part may round below 0 where one station is alone.
    rest = np.maximum(received, 0.0) + noise
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = to_decibels(signal / rest)
    return np.where(known & (rest > 0), ratio, np.nan)


def count_overlap(power_db: np.ndarray, carrier: np.ndarray) -> np.ndarray:
    """Count stations (n,) within `OVERLAP_DB` of the strongest of (T, n) powers [dB], itself too,
    on its carrier.

    Returns:
        NaN where no power is known.
    """
    known, first, cell = _strongest(power_db)
    near = (power_db >= power_db[first, cell] - OVERLAP_DB) & (carrier[:, None] == carrier[first])
    return np.where(known, near.sum(0), np.nan).astype(np.float32)


def read_loads(
    load: float | Sequence[float] | Mapping[str, float],
    stations: Sequence[str],
    labels: Sequence[str] = (),
) -> np.ndarray:
    """Return loads (T,) in [0, 1] of one number, one per station,
    or by name or label (the others 1).

    Raises:
        DataError: another number of them, an unknown name, or no share.
    """
    if isinstance(load, Mapping):
        if wrong := sorted(load.keys() - {*stations, *labels}):
            raise DataError(f"load: no station {wrong[0]!r}; there are {', '.join(stations)}")
        load = [
            load.get(a, load.get(b, 1.0)) for a, b in zip(stations, labels or stations, strict=True)
        ]
    values = finite_array(load)
    if (
        values.ndim > 1
        or values.size not in (1, len(stations))
        or not ((values >= 0) & (values <= 1)).all()
    ):
        fault = f"shares from 0 to 1 are needed: one number, or {len(stations)}, one per station"
        raise DataError(f"load={load}: {fault}")
    return np.broadcast_to(values, (len(stations),))


def compute_map_layers(
    scales: IntervalScales,
    mean: np.ndarray,
    spread: np.ndarray,
    related: np.ndarray,
    far: np.ndarray,
    indoors: np.ndarray | None,
    *,
    numbers: np.ndarray,
    load: np.ndarray,
    carrier: np.ndarray,
    floor: np.ndarray,
    threshold_db: float,
    noise_db: float | None,
    loss: np.ndarray | None,
) -> dict[str, np.ndarray]:
    """Return layers (..., n) of squares by name, from levels of T stations.

    Args:
        scales: of deviations, as held-out rows tell.
        mean, spread: (T, n) levels and the model's own deviations [dB].
        related: (T, n) correlation of their errors with the strongest's.
        far: (T, n) distances from what was measured [m].
        indoors: (n,) bool, squares in buildings.
        numbers: (T,) of the stations in the model.
        load, carrier: (T,), see `sinr`.
        floor: (T,) levels below which stations are not heard [dB].
        threshold_db: of outage.
        noise_db: see `sinr`.
        loss: (2,) of squares in buildings, and its deviation [dB]; None: none is mapped there.
    """
    half, error = scales.half_and_error(spread, far, numbers[:, None])
    if loss is not None and indoors is not None:
        loss_db, doubt = np.outer(loss, indoors)
        wider, strongest = np.hypot(error, doubt), (mean.argmax(0), np.arange(len(indoors)))
        # What is not known of the loss is one error of all stations.
        related = (related * error * error[strongest] + doubt**2) / (wider * wider[strongest])
        half = np.hypot(half, half_width(scales.share) * doubt)
        mean, error = mean - loss_db, wider
    # The strongest before anything is refused, to which `related` is the correlation.
    first, mean = best_server(mean), np.where(np.isfinite(half), mean, np.nan)
    error = np.where(np.isfinite(mean), error, np.nan)
    # To float32 before comparing: what is stored decides the best server.
    power, error = mean.astype(np.float32), error.astype(np.float32)
    best = best_server(power)
    strongest = np.maximum(best, 0), np.arange(len(best))
    below = scales.probability_below(threshold_db, power[strongest], error[strongest])
    alike = np.where(first == best, np.nan_to_num(related), 0.0)
    return {
        "power_db": power,
        "lower_db": mean - half,
        "upper_db": mean + half,
        "expected_error_db": error,
        "best_server": best,
        "sinr_db": sinr(power, load, noise_db, carrier),
        "server_chance": server_chance(power, error, floor, alike),
        "heard_chance": heard_chance(power, error, floor),
        "outage": outage_probability(power, error, threshold_db, alike, below),
        "overlap": count_overlap(power, carrier),
    }
