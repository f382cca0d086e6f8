"""The experiments on one model: true and predicted channels of test positions, what is sent over
them, and what came of it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gsparc.apps.link import study
from gsparc.apps.link.adaptation import RULES, Band, Rates
from gsparc.apps.link.pusch import NEEDED, RECEIVERS, Pusch, frequency_correlation
from gsparc.base.limits import SHARE, or_null
from gsparc.data.schema import Measurements
from gsparc.datasets.argos import FACTS
from gsparc.models.method import Method, Prediction
from gsparc.models.uplink.interface import SeparatesPaths, UplinkMethod
from gsparc.physics.row_factors import align_factors
from gsparc.prediction.channels import SUBCARRIERS_PER_BLOCK, centred_grid, interpolate_tones
from gsparc.prediction.confidence import Guarantee, as_confidence, confidence_threshold
from gsparc.prediction.left_out import Evidence, score_answers
from gsparc.prediction.risk import calibrate_threshold
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.runs.open_runs import Opened

if TYPE_CHECKING:
    from gsparc.simulate.argos_sim import World


# 32 positions x antennas x fine tones bound what is held at once.
CHUNK = 32
SLOT = 14  # symbols
# Of true and of predicted channels of beams: .5 GB with what is made of them
BEAM_ENTRIES = 1 << 24


@dataclass(frozen=True)
class BandChannels:
    """One band at n positions.

    Attributes:
        true: (n, A, K) complex64; of simulated streets exact, else interpolated from measured
            tones.
        predicted: (n, A, K) complex64.
        variance: (n,) expected squared error per entry of this very band; NaN where the method
            gives none.
        confidence: (n,) the method's own; NaN where it has none.
        source: where the truth comes from, for the summary.
    """

    true: Tensor
    predicted: Tensor
    variance: Tensor
    confidence: Tensor
    source: str

    def select_positions(self, index: np.ndarray) -> BandChannels:
        """Return some of the positions."""
        at = torch.from_numpy(index)
        return BandChannels(
            self.true[at], self.predicted[at], self.variance[at], self.confidence[at], self.source
        )

    def band(self) -> Band:
        """Return the first antenna's band; what states no variance is taken for exact."""
        return Band(self.true[:, 0], self.predicted[:, 0], self.variance.nan_to_num(0.0))


def predict_channels(
    method: Method,
    data: Measurements,
    rows: np.ndarray,
    frequency_hz: np.ndarray,
    antennas: slice = slice(None),
) -> BandChannels:
    """Return true and predicted channels of rows (n,) at absolute frequencies (K,) [Hz],
    of some of the antennas.

    Raises:
        ValueError: a frequency outside the measured band.
    """
    assert data.site.subcarriers_hz is not None
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for start in range(0, len(rows), CHUNK):
        batch = data.batch(rows[start : start + CHUNK])
        # What separates paths answers at any frequency;
        # others are interpolated between measured tones.
        if isinstance(method, SeparatesPaths) and batch.uplink is not None:
            wanted = torch.from_numpy(frequency_hz)
            answer = method.predict_from_uplink(
                batch.uplink, wanted, batch.noise_variance, antennas
            )
        else:
            answer = method.predict(batch)
            # The variance stays that of measured tones: interpolation is smooth between them.
            mean = interpolate_tones(
                answer.mean[:, antennas], data.site.subcarriers_hz, frequency_hz
            )
            answer = Prediction(mean, answer.variance, answer.unknown)
        none = torch.full((len(batch),), torch.nan)
        variance, confidence = (
            none if x is None else x for x in (answer.variance, answer.confidence)
        )
        parts.append((answer.mean, variance, confidence))
    true, source = true_channels(data, rows, frequency_hz)
    predicted, variance, confidence = map(torch.cat, zip(*parts, strict=True))
    return BandChannels(true[:, antennas], predicted, variance, confidence, source)


def true_channels(
    data: Measurements, rows: np.ndarray, frequency_hz: np.ndarray
) -> tuple[Tensor, str]:
    """Return true channels (n, A, K) in the data's units and frame, and how they were come by."""
    assert data.site.subcarriers_hz is not None
    if data.site.name == "argos-sim" and data.uplink is not None:
        return _of_streets(data, rows, frequency_hz), "rays"
    measured = data.targets(rows)
    return interpolate_tones(measured, data.site.subcarriers_hz, frequency_hz), (
        "measured tones, interpolated"
    )


def band_evidence(band: BandChannels, data: Measurements, rows: np.ndarray) -> Evidence:
    """Return evidence of `rows`, whose channels `band` holds:
    a fade of this band is no fade of another.
    """
    prediction = Prediction(band.predicted, band.variance, 1 - band.confidence)
    return score_answers(prediction, band.true, rows, data.moving[rows])


@lru_cache(maxsize=1)
def _streets(*facts: int) -> World:
    from gsparc.simulate.argos_sim import simulate_world

    return simulate_world(*facts)


def _of_streets(data: Measurements, rows: np.ndarray, frequency_hz: np.ndarray) -> Tensor:
    """Rays at these frequencies, turned as each snapshot was (phase
    and timing, found on its uplink).
    """
    site, uplink = data.site, data.uplink
    assert uplink is not None and site.uplink_hz is not None and site.antennas is not None
    there = _streets(*(int(data.provenance[name]) for name in FACTS if name in data.provenance))
    heard = uplink[rows].astype(np.complex128) * site.target_scale
    # Simulated streets know the channel, but each snapshot was turned by its own phase and timing.
    clean = there.response(site.uplink_hz, rows)
    coarse = align_factors(heard, clean, site.uplink_hz, "phase+delay")
    # The grid of delays leaves a tenth of a nanosecond:
    # the slope of the remaining phase takes it out.
    rest = (heard * coarse[:, None] * clean.conj()).sum(1)
    away = site.uplink_hz - site.uplink_hz.mean()
    weight = np.abs(rest)
    middle = np.angle(rest.sum(1, keepdims=True))
    # About the middle phase: deviations then stay within +-pi and need no unwrapping.
    angle = np.angle(rest * np.exp(-1j * middle))
    mean = (weight * away).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    # Least squares weighed by power: slope and level of the phase over frequency.
    slope = (weight * (away - mean) * angle).sum(1) / (weight * (away - mean) ** 2).sum(1)
    level = ((weight * angle).sum(1) / weight.sum(1) - slope * mean[:, 0]) + middle[:, 0]
    wanted = there.response(frequency_hz, rows)[:, site.antennas]
    # The phase of a delay is a line over tones, which goes on beyond them as from one to the next.
    first, second = site.uplink_hz[:2]
    step = np.angle(coarse[:, 1:2] / coarse[:, :1]) / (second - first)
    turn = -np.angle(coarse[:, :1]) - step * (frequency_hz - first)
    turn = turn + level[:, None] + slope[:, None] * (frequency_hz - site.uplink_hz.mean())
    turned = wanted * np.exp(1j * turn)[:, None] / site.target_scale
    return torch.from_numpy(turned.astype(np.complex64))


log = logging.getLogger(__name__)

SHARES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class LinkStudy:
    """Test positions on which nothing was chosen, and which of them the promise accepts.

    What is accepted is judged on the band that is used: one antenna, the PUSCH grid.

    Args:
        run: the model and its data.
        settings: see conf/link.yaml.

    Raises:
        ValueError: no channels with their frequencies, or no such antenna.
    """

    def __init__(self, run: Opened, settings: Mapping[str, Any]) -> None:
        self.method, self.data, self.fold = run.methods[0], run.data, run.split.folds[0]
        site, self.antenna, self.shape = run.data.site, int(settings["antenna"]), settings["pusch"]
        if not site.target.is_complex or site.subcarriers_hz is None:
            raise ValueError(
                f"gsparc link needs complex channels with their frequencies, not {site.kind}"
            )
        site.need_phase("gsparc link")
        if len(site.subcarriers_hz) == 1 and not settings["flat"]:
            raise ValueError(
                f"gsparc link: {site.name} has one tone, which says nothing of the other "
                f"{settings['mcs']['subcarriers'] - 1} subcarriers of a link; flat=true takes its "
                "channel for all of them, and measuring two tones or more tells how they differ"
            )
        RULES.check("rule", settings["rule"])
        for name in (receivers := list(settings["receivers"])):
            RECEIVERS.check("receivers", name)
        if missing := [name for name in NEEDED if name not in receivers]:
            raise ValueError(f"receivers={receivers}: {' and '.join(missing)} must be among them")
        or_null(SHARE).check("threshold", settings["threshold"])
        if not 0 <= self.antenna < (antennas := run.data.target.shape[1]):
            raise ValueError(
                f"antenna={self.antenna}: the channels have {antennas}, numbered from 0"
            )
        self.tones, self.mcs, self.rule = site.subcarriers_hz, settings["mcs"], settings["rule"]
        self.count = SUBCARRIERS_PER_BLOCK * self.shape["blocks"]
        self.spacing_hz = 1e3 * self.shape["spacing_khz"]
        self.one = slice(self.antenna, self.antenna + 1)
        # The PUSCH grid around the measured band's middle, whatever tones were measured.
        frequency_hz = centred_grid(float(self.tones.mean()), self.spacing_hz, self.count)
        grid = predict_channels(self.method, self.data, self.fold.test, frequency_hz, self.one)
        evidence = band_evidence(grid, self.data, self.fold.test)
        promise = Guarantee(**settings["promise"])
        kind, threshold, self.test, aside = calibrate_threshold(
            evidence, promise, settings["confidence"], settings["spatial"], int(settings["seed"])
        )
        confidences, setting = as_confidence(kind, evidence.scores[kind]), settings["threshold"]
        self.least = confidence_threshold(kind, threshold) if setting is None else float(setting)
        self.confidence = confidences[self.test]
        self.accepted = self.confidence >= self.least
        # Rates are tuned on rows set aside from the test, and on those that would be accepted.
        rows = aside[confidences[aside] >= self.least]
        self.aside = rows if len(rows) else aside
        states_variance = bool(grid.variance.isfinite().all())
        if not states_variance:
            text = (
                "%s states no error variance: rates are chosen as if it were exact, pilots do "
                "not mend it"
            )
            log.warning(text, self.method.name)
        self.receivers = [
            name for name in receivers if name != "predicted_pilots" or states_variance
        ]
        self.grid, bad = grid.select_positions(self.test), promise.is_bad(evidence.error[self.test])
        self.facts: dict[str, Any] = {
            "seed": int(settings["seed"]),
            "positions": len(self.test),
            "confidence/kind": kind,
            "accepted": float(self.accepted.mean()),
            "promise/limit_db": promise.limit_db,
            "promise/bad_among_accepted": float(bad[self.accepted].mean())
            if self.accepted.any()
            else None,
            "threshold": self.least if np.isfinite(self.least) else None,
            "model/states_variance": states_variance,
        }
        if setting is None:  # a threshold by hand promises nothing
            self.facts |= {
                "promise/alpha": promise.alpha,
                "promise/delta": promise.delta,
                "promise/calibrated_on": threshold.accepted,
                "promise/bound": threshold.bound(promise.delta),
            }

    def beams(self) -> dict[str, Any]:
        """Return `beams/*` of all test positions, as nothing of a beam was chosen on any.

        Empty for one antenna.
        """
        if self.data.target.shape[1] == 1:
            return {}
        entries = self.data.target.shape[1] * len(self.tones)
        some = sample_row_numbers(
            len(self.fold.test), max(BEAM_ENTRIES // entries, 1), self.facts["seed"]
        )
        if len(some) < len(self.fold.test):
            log.info("beams of %d drawn test positions: the channels of all fill memory", len(some))
        channels = predict_channels(self.method, self.data, self.fold.test[some], self.tones)
        # `test` are numbers into the fold's test rows, as `accepted` are into `test`.
        accepted = np.isin(some, self.test[self.accepted])
        return study.beam_facts(channels.true, channels.predicted, accepted)

    def rates(self) -> tuple[list[Rates], dict[str, Any]]:
        """Return rate adaptation at every noise level and its facts."""
        test_band, other = (
            predict_channels(
                self.method, self.data, self.fold.test[rows], self.tones, self.one
            ).band()
            for rows in (self.test, self.aside)
        )
        rates = study.adapt_rates(test_band, other, self.mcs, self.rule)
        return rates, study.rate_facts(rates, self.accepted)

    def send(
        self, modulation: str, levels: list[float]
    ) -> tuple[dict[str, pd.DataFrame], tuple[float, pd.DataFrame], dict[str, Any]]:
        """Return `curves`, `acceptance` and facts of blocks at every Eb/N0 [dB]."""
        begun = time.perf_counter()
        # Only training rows: the estimator's correlation must not know test channels.
        heard = self.data.targets(self.fold.train)[:, self.antenna]
        correlation = frequency_correlation(heard, self.tones, self.spacing_hz, self.count)
        shape = self.shape
        pusch = Pusch(
            modulation,
            shape["blocks"],
            shape["spacing_khz"],
            correlation,
            shape["iterations"],
            self.receivers,
        )
        sizes = shape["coarse"], shape["fine"], shape["batch"]
        blocks = study.send_blocks(pusch, self.grid.band(), levels, sizes)
        rates = study.error_curves(blocks, self.accepted)
        surest = study.errors_by_acceptance(blocks, self.confidence, SHARES)
        facts = study.pusch_facts(modulation, rates)
        for name in ("perfect", "predicted"):
            shares = surest[1][name].items()
            facts |= {
                f"tradeoff/{modulation}/{name}/{share:.0%}": float(rate) for share, rate in shares
            }
        facts |= {
            "pusch/truth": self.grid.source,
            "pilots/share_of_slot": pusch.pilot_share,
            # An accepted position needs no pilots at all.
            "pilots/saved": pusch.pilot_share * float(self.accepted.mean()),
            # One symbol of sounding that every antenna hears, in each slot
            "pilots/uplink": 1 / SLOT if isinstance(self.method, UplinkMethod) else 0.0,
            f"time/pusch_{modulation}_s": time.perf_counter() - begun,
        }
        return rates, surest, facts
