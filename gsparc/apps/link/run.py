"""The experiments on one model: what is sent over which positions, and what came of it."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from gsparc.apps.link import study
from gsparc.apps.link.adaptation import RULES, Rates
from gsparc.apps.link.channels import band_evidence, predict_channels
from gsparc.apps.link.pusch import NEEDED, RECEIVERS, Pusch, frequency_correlation
from gsparc.base.limits import SHARE, or_null
from gsparc.prediction.channels import SUBCARRIERS_PER_BLOCK, centred_grid
from gsparc.prediction.confidence import Guarantee, as_confidence, confidence_threshold
from gsparc.prediction.risk import calibrate_threshold
from gsparc.runs.open_runs import Opened

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
        evidence = band_evidence(grid, self.data, self.fold, self.fold.test)
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
        channels = predict_channels(self.method, self.data, self.fold.test, self.tones)
        # `test` are numbers into the fold's test rows, as `accepted` are into `test`.
        accepted = np.isin(np.arange(len(self.fold.test)), self.test[self.accepted])
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
            f"time/pusch_{modulation}_s": time.perf_counter() - begun,
        }
        return rates, surest, facts
