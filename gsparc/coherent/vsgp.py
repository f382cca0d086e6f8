"""`model=vsgp`: channels from virtual sources found by search, averaged over searches, with a variance."""

from __future__ import annotations

import logging
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.coherent.inphase import PhasedPosterior, PhasedScene
from gsparc.coherent.process import Scene
from gsparc.coherent.query import Query
from gsparc.coherent.rows import Rows, gather, query_elements, tones_of
from gsparc.coherent.search import Search, SearchSettings
from gsparc.coherent.settle import settle
from gsparc.coherent.visibility import KernelVisibility
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.method import FitReport, Method, Prediction
from gsparc.ops import Pose

log = logging.getLogger(__name__)

SECONDS_PER_MEASUREMENT = 0.4  # a conference room of 350 gets 140 s
TURNING = 0.4  # share of a gain's variation that is not along its phase, before it is learned
LEAST_BUDGET_S, MOST_BUDGET_S = 120.0, 480.0


@dataclass(frozen=True)
class Frame:
    """How local metres and stored units become the search's.

    Attributes:
        middle: (3,) float64 [m], local; the search works about it.
        scale: stored target = scale * search target.
        carrier_hz: amplitude goes with wavelength, so targets are multiplied by f / carrier first [Hz].
    """

    middle: Tensor
    scale: float
    carrier_hz: float

    def inside(self, rows: Rows) -> Rows:
        """Rows in local metres and stored units, as the search wants them."""
        flat = rows.target * (rows.frequency / self.carrier_hz)[:, None].float() / self.scale
        return replace(rows.moved(-self.middle), target=flat)


class VirtualSourceGP(Method):
    """The virtual-source Gaussian process for a moving receiver.

    Args:
        searches: how many, with different seeds; their predictions are averaged.
        budget_s: no search starts that would end after this; None: 0.4 s per measurement, 120 to 480 s.
        search_rows: receivers times tones that a search looks at.
        rows: receivers times tones that the final process holds.
        margin, max_sources, order: see `SearchSettings`.
        seed: of everything random.

    Raises:
        ValueError: the data are not channels, or their phase means nothing.
    """

    name = "vsgp"

    def __init__(
        self,
        searches: int = 4,
        budget_s: float | None = None,
        search_rows: int = 700,
        rows: int = 3000,
        margin: float = 8.0,
        max_sources: int = 60,
        order: int = 3,
        seed: int = 0,
    ) -> None:
        if searches < 1:
            raise ValueError(f"vsgp: searches must be at least 1, got {searches}")
        if search_rows < 8 or rows < 8:
            raise ValueError(f"vsgp: search_rows and rows must be at least 8, got {search_rows} and {rows}")
        self.searches, self.budget_s, self.seed = searches, budget_s, seed
        self.search_rows, self.row_limit = search_rows, rows
        self.settings = SearchSettings(margin=margin, max_sources=max_sources, order=order)
        self.site: Site | None = None
        self.members: list[PhasedPosterior] = []

    # ---- learning ----
    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Search on `train` and `val` together: the number of sources is chosen by likelihood."""
        started = time.monotonic()
        _refuse(data.site)
        known = np.concatenate([fold.train, fold.val])
        self.site, self.antennas = data.site, data.target.shape[1]
        everything = gather(data, known, self.row_limit, self.seed)
        self.frame = _frame(data.site, everything)
        noise = None if data.noise_variance is None else float(np.mean(data.noise_variance[known]))
        self.noise_floor = max(1e-5, 0.0 if noise is None else noise / self.frame.scale**2)
        held = self.frame.inside(everything)
        scenes, notes = self._search_all(data, known, started)
        self.members = [PhasedPosterior(held, scene, self.noise_floor) for scene in scenes]
        self.query = Query(self.members)
        return FitReport(time.monotonic() - started, tuple(notes))

    def _search_all(
        self, data: Measurements, known: np.ndarray, started: float
    ) -> tuple[list[PhasedScene], list[str]]:
        budget = self.budget_s
        if budget is None:
            budget = min(max(SECONDS_PER_MEASUREMENT * len(known), LEAST_BUDGET_S), MOST_BUDGET_S)
        threads = torch.get_num_threads()
        longest = 0.0

        def search(number: int) -> PhasedScene | None:
            nonlocal longest
            begun = time.monotonic()
            if number > 0 and begun + longest > started + budget:
                return None
            rows = self.frame.inside(gather(data, known, self.search_rows, self.seed + number))
            finder = Search(
                rows, self._start(data.site), self.settings, self.seed + number, started + 0.8 * budget
            )
            scene = finder.run()
            phased = settle(rows, PhasedScene.of(rows, scene, TURNING), self.settings.visibility)
            longest = max(longest, time.monotonic() - begun)
            log.info(
                "search %d of %d: %d sources over %d planes, %.0f of %.0f s",
                number + 1, self.searches, len(scene.words), len(scene.planes),
                time.monotonic() - started, budget,
            )  # fmt: skip
            return phased

        # Matrices of a few hundred rows gain nothing from two threads; two searches do.
        torch.set_num_threads(1)
        try:
            with ThreadPoolExecutor(max(1, min(threads, self.searches))) as pool:
                found = [one for one in pool.map(search, range(self.searches)) if one is not None]
        finally:
            torch.set_num_threads(threads)
        counts = ", ".join(str(len(phased.scene.words)) for phased in found)
        notes = [f"vsgp: {len(found)} of {self.searches} searches in {budget:.0f} s, {counts} sources"]
        return found, notes

    def _start(self, site: Site) -> Tensor:
        assert site.static_position is not None
        return torch.from_numpy(np.asarray(site.static_position, np.float64)) - self.frame.middle

    # ---- predicting ----
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`.

        The variance is the posterior's plus the searches' spread; the confidence is the share of the power
        expected there that is known.
        """
        site = self._fitted()
        if site.moving_end == "rx":
            places = query_elements(site, rx, len(tx), self.antennas)
        else:
            places = tx.detach().cpu().double().numpy()[:, None]
        count, per = places.shape[:2]
        flat = torch.from_numpy(places.reshape(-1, 3).copy()) - self.frame.middle
        tones = torch.from_numpy(tones_of(site))
        stack, variance, prior = self.query.means(flat, tones)  # (members, B E, R, K)
        mean = stack.mean(0)
        variance = variance + (stack - mean).abs().square().mean(0).flatten(1).mean(1)
        loudness = (self.frame.carrier_hz / tones).float()
        mean = (mean * (loudness * self.frame.scale)).reshape(count, self.antennas, len(tones))
        variance, prior = (v.reshape(count, per).mean(1) for v in (variance, prior))
        return Prediction(
            mean,
            confidence=(1 - variance / prior).clamp(0, 1),
            variance=variance * self.frame.scale**2,
        )

    # ---- keeping ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        self._fitted()
        rows = self.members[0].rows
        return {
            "antennas": self.antennas,
            "noise_floor": self.noise_floor,
            "frame": [self.frame.middle, self.frame.scale, self.frame.carrier_hz],
            "rows": [rows.position, rows.frequency, rows.target, rows.receiver],
            "scenes": [_scene_state(member.phased) for member in self.members],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.antennas = site, int(state["antennas"])
        self.noise_floor = float(state["noise_floor"])
        self.frame = Frame(*state["frame"])
        rows = Rows(*state["rows"])
        self.members = [PhasedPosterior(rows, _scene(stored), self.noise_floor) for stored in state["scenes"]]
        self.query = Query(self.members)

    def size(self) -> int:
        """Sources of the largest scene."""
        return max((len(member.scene.words) for member in self.members), default=0)

    def _fitted(self) -> Site:
        if self.site is None or not self.members:
            raise ValueError("vsgp: not fitted yet; call fit or restore first")
        return self.site


def _refuse(site: Site) -> None:
    if site.kind != "csi":
        raise ValueError(f"vsgp: needs complex channels (csi), {site.name} has {site.kind}; take model=gp")
    if site.static_position is None:
        raise ValueError(f"vsgp: {site.name} does not say where its static end is; take model=complex_gp")
    if site.static_end == "rx" and site.array is not None and len(site.array) > 1:
        raise ValueError(
            f"vsgp: in {site.name} the transmitter moves before an array; that needs mirrored arrays"
        )


def _frame(site: Site, rows: Rows) -> Frame:
    frequency = tones_of(site)
    carrier = float(frequency.mean()) if site.carrier_hz is None else float(site.carrier_hz)
    power = (rows.target * (rows.frequency / carrier)[:, None].float()).abs().square().mean()
    return Frame(rows.position.mean(0), max(math.sqrt(float(power)), 1e-30), carrier)


def _scene_state(phased: PhasedScene) -> dict[str, Any]:
    scene = phased.scene
    law = scene.visibility
    assert isinstance(law, KernelVisibility)
    return {
        "transmitter": scene.transmitter,
        "planes": scene.planes,
        "words": [list(word) for word in scene.words],
        "log_amplitude": scene.log_amplitude,
        "log_noise": scene.log_noise,
        "visibility": [float(law.constant), float(law.angle), float(law.length)],
        "phase": phased.phase,
        "turning": phased.turning,
    }


def _scene(state: dict[str, Any]) -> PhasedScene:
    scene = Scene(
        state["transmitter"],
        state["planes"],
        tuple(tuple(word) for word in state["words"]),
        state["log_amplitude"],
        float(state["log_noise"]),
        KernelVisibility(*state["visibility"]),
    )
    return PhasedScene(scene, state["phase"], float(state["turning"]))
