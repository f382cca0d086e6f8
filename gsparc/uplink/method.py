"""`model=uplink`: find the sources in the fresh uplink, hear them again in the downlink's band."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.method import FitReport, Prediction
from gsparc.uplink.atoms import Aperture, Sources, flat_places, mean_delay, phasor
from gsparc.uplink.face import UplinkMethod
from gsparc.uplink.search import SearchSettings, SourceSearch
from gsparc.uplink.trust import Trust, learn, signs, unheard_noise

LIGHT = 299_792_458.0  # [m/s]
CHUNK = 32  # snapshots searched together
LEAKAGES = (1e-4, 3e-4, 1e-3)


class UplinkField(UplinkMethod):
    """A field of plane-wave sources, found anew in every snapshot.

    Directions and delays are the same in both halves of a band; only their interference differs. What is
    learned from training snapshots is how much the hardware leaks, and how wrong a set of sources will be.

    Args:
        search: how sources are looked for.
        teachers: training snapshots that the confidence is learned from, at most.
        shrink: pull predictions towards zero by the error that is to be expected.
        seed: of the draw of the teachers.
    """

    name = "uplink"

    def __init__(
        self,
        search: SearchSettings | None = None,
        teachers: int = 1200,
        shrink: bool = True,
        seed: int = 0,
    ) -> None:
        if teachers < 50:
            raise ValueError(f"uplink: teachers={teachers}: expected at least 50 snapshots")
        self.settings, self.teachers = search or SearchSettings(), teachers
        self.shrink, self.seed = shrink, seed
        self.trust: Trust | None = None

    # ---- learning ----
    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Choose the leakage on validation rows, learn the confidence on training rows."""
        started = time.perf_counter()
        self.site = self._need_uplink(data)
        self.trust = None
        rng = np.random.default_rng(self.seed)
        few = rng.permutation(fold.val if len(fold.val) else fold.train)[:100]
        errors = {}
        for leakage in LEAKAGES:
            self._prepare(self.site, replace(self.settings, leakage=leakage))
            errors[leakage] = float(np.median(self._taught(data, few)[1]))
        best = min(errors, key=lambda leakage: errors[leakage])
        self._prepare(self.site, replace(self.settings, leakage=best))
        # Nothing of the search is fitted to training rows: their errors are as honest as any.
        rows = rng.permutation(fold.train)[: self.teachers]
        seen, wrong = self._taught(data, rows)
        self.trust = learn(seen, wrong)
        note = f"uplink: leakage {best:g} chosen on {len(few)} validation snapshots"
        return FitReport(time.perf_counter() - started, (note,))

    def _taught(self, data: Measurements, rows: np.ndarray) -> tuple[Tensor, Tensor]:
        """Signs (n, 7) and relative errors (n,) of snapshots whose downlink is known."""
        seen, wrong = [], []
        for start in range(0, len(rows), CHUNK):
            batch = data.batch(rows[start : start + CHUNK])
            assert batch.uplink is not None
            found, some = self._search(batch.uplink, batch.noise_variance)
            miss = self._heard(found) - batch.target
            wrong.append(_power(miss) / _power(batch.target).clamp_min(1e-30))
            seen.append(some)
        return torch.cat(seen), torch.cat(wrong)

    # ---- answering ----
    def sources(self, uplink: Tensor, noise: Tensor | None = None) -> Sources:
        """The sources of snapshots (B, U, L): directions, delays, gains."""
        return self._search(uplink, noise)[0]

    @torch.no_grad()
    def listen(self, uplink: Tensor, noise: Tensor | None = None) -> Prediction:
        """See `UplinkMethod.listen`; the variance is the expected squared error per entry."""
        assert self.trust is not None
        found, seen = self._search(uplink, noise)
        return self._judged(self._heard(found), seen)

    @torch.no_grad()
    def listen_at(self, uplink: Tensor, frequency_hz: Tensor, noise: Tensor | None = None) -> Prediction:
        """The same at absolute frequencies (K,) [Hz] of one's own."""
        found, seen = self._search(uplink, noise)
        tones = ((frequency_hz.double() - self._middle_hz) / self._spacing_hz).float()
        return self._judged(found.response(self._downlink.at(tones)), seen)

    def _judged(self, mean: Tensor, seen: Tensor) -> Prediction:
        assert self.trust is not None
        wrong = self.trust.expected(seen)
        if self.shrink:
            mean = mean / (1 + wrong)[:, None, None]
        return Prediction(mean, confidence=1 / (1 + wrong), variance=wrong * _power(mean))

    def _search(self, uplink: Tensor, noise: Tensor | None) -> tuple[Sources, Tensor]:
        aperture = self.search.aperture
        if noise is None:
            noise = unheard_noise(uplink, aperture, self.settings.delay_window)
        # Timing is the snapshot's own: delays are sought about their mean, and put back where they were.
        mean = mean_delay(uplink)
        straight = uplink * phasor(mean[:, None] * aperture.tones)[:, None]
        parts = [
            self.search(straight[i : i + CHUNK], noise[i : i + CHUNK]) for i in range(0, len(uplink), CHUNK)
        ]
        found = Sources(*(torch.cat([getattr(p, name) for p, _ in parts]) for name in vars(parts[0][0])))
        left = torch.cat([rest for _, rest in parts])
        seen = signs(found, left, uplink, noise, self._downlink.tones)
        return replace(found, delay=found.delay + mean[:, None]), seen

    def _heard(self, found: Sources) -> Tensor:
        return found.response(self._downlink)

    def _prepare(self, site: Site, settings: SearchSettings) -> None:
        assert site.uplink_hz is not None and site.uplink_array is not None and site.antennas is not None
        assert site.subcarriers_hz is not None and site.carrier_hz is not None
        self._middle_hz = float(site.uplink_hz.mean())
        self._spacing_hz = float(np.diff(np.sort(site.uplink_hz)).min())
        places = flat_places(site.uplink_array, LIGHT / site.carrier_hz)

        def tones(frequency: np.ndarray) -> Tensor:
            return torch.from_numpy((frequency - self._middle_hz) / self._spacing_hz).float()

        self.search = SourceSearch(Aperture(places, tones(site.uplink_hz)), settings)
        chosen = torch.from_numpy(np.asarray(site.antennas))
        self._downlink = Aperture(places[chosen], tones(site.subcarriers_hz))

    # ---- keeping ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        trust = None if self.trust is None else vars(self.trust)
        return {"search": asdict(self.search.settings), "trust": trust}

    def restore(self, site: Site, state: Mapping[str, Any]) -> None:
        """See `Method.restore`."""
        self.site = site
        self._prepare(site, SearchSettings(**state["search"]))
        self.trust = None if state["trust"] is None else Trust(**state["trust"])

    def size(self) -> int:
        """Sources of a snapshot."""
        return self.settings.rounds * self.settings.picks


def _power(channel: Tensor) -> Tensor:
    return channel.abs().square().mean((1, 2))
