"""`model=vsgp`: channels from virtual sources found by search, averaged over searches, with a variance."""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import FitContext, FitReport, LeftOut, Method, Prediction, PredictsVariance
from gsparc.methods.pareto import Settings
from gsparc.multipath.clutter.blocking import Clutter
from gsparc.multipath.diffraction import Edges, diffracted, edge_wave, find_edges, with_gains, without
from gsparc.multipath.ensemble import Budget, Member, agreed, search_many, weights
from gsparc.multipath.frame import Frame, frame_of, refuse
from gsparc.multipath.gp_likelihood import Scene
from gsparc.multipath.phase_offsets import KINDS, Offsets, estimate
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene
from gsparc.multipath.query import Query
from gsparc.multipath.reduce import reduced
from gsparc.multipath.rows import Rows, elements, gather, query_elements
from gsparc.multipath.search import SearchSettings
from gsparc.multipath.search_cache import Shelf
from gsparc.multipath.source_types import SourceKind, box_of, kinds
from gsparc.multipath.visibility_kernel import KernelVisibility
from gsparc.ops import Pose
from gsparc.physics.waves import LIGHT, ranges, wave, wave_over_band

log = logging.getLogger(__name__)

SECONDS = 0.02  # times measurements^1.5: a conference room of 350 gets 130 s, 700 get 370
LEAST_BUDGET_S, MOST_BUDGET_S = 120.0, 400.0
CLEARLY = 0.8  # left-out error beside edges over that without, for edges to stay
AGAIN = 0.2  # of the budget, at least, for searching again beside edges
ALIGNING = (8, 20)  # sources of the searches that offsets are estimated against
ALIGNMENTS = 3  # estimates of offsets and gains in turn, after each


class VirtualSourceGP(PredictsVariance):
    """The virtual-source Gaussian process for a moving receiver, or for a transmitter before one antenna.

    Args:
        searches: how many, with different seeds; their predictions are averaged.
        budget_s: what all searches may take, about; None: 120 to 400 s, growing with the
            measurements.
        search_rows: receivers times tones that a search looks at.
        rows: receivers times tones that the final process holds.
        margin, max_sources, order: see `SearchSettings`.
        offsets: what every snapshot has of its own: `none`, `phase`, or `phase_timing`; it is estimated.
        clutter: look for occluding boxes and finite mirrors, shared by all sources.
        edges: look for edges, whose diffraction point slides with the receiver; kept when the likelihood
            wants them.
        seed: of everything random.

    Raises:
        ValueError: the data are not channels, or their phase means nothing.
    """

    name = "image_source_gp"

    def __init__(
        self,
        searches: int = 6,
        budget_s: float | None = None,
        search_rows: int = 700,
        rows: int = 3000,
        margin: float = 8.0,
        max_sources: int = 60,
        order: int = 3,
        offsets: Offsets = "none",
        clutter: bool = True,
        edges: bool = True,
        seed: int = 0,
    ) -> None:
        if offsets not in KINDS:
            raise ValueError(f"{self.name}: offsets={offsets!r} is none of {', '.join(KINDS)}")
        if searches < 1:
            raise ValueError(f"{self.name}: searches must be at least 1, got {searches}")
        if search_rows < 8 or rows < 8:
            raise ValueError(f"{self.name}: search_rows={search_rows}, rows={rows}: at least 8 are needed")
        self.searches, self.budget_s, self.seed = searches, budget_s, seed
        self.offsets, self.clutter, self.look_for_edges = offsets, clutter, edges
        self.edges = Edges.none()
        self.search_rows, self.row_limit = search_rows, rows
        self.settings = SearchSettings(margin=margin, max_sources=max_sources, order=order)
        self.site: Site | None = None
        self.members: list[PhasedPosterior] = []

    # ---- learning ----
    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Search on `train` and `val` together: the number of sources is chosen by likelihood."""
        started = time.monotonic()
        refuse(data.site, self.name, data.target.shape[1])
        known = np.concatenate([fold.train, fold.val])
        self.site, self.antennas = data.site, data.target.shape[1]
        everything = gather(data, known, self.row_limit, self.seed)
        self.frame = frame_of(data.site, everything)
        noise = None if data.noise_variance is None else float(np.mean(data.noise_variance[known]))
        self.noise_floor = max(1e-5, 0.0 if noise is None else noise / self.frame.scale**2)
        held = self.frame.inside(everything)
        notes = []
        if self.offsets != "none":
            data = self._aligned(data, known)
            held = self.frame.inside(gather(data, known, self.row_limit, self.seed))
            notes.append(f"{self.name}: {self.offsets} of every snapshot estimated; predictions have none")
        shelf = Shelf(context.run_dir, context.resume, self._key(data, known), _scene_state, _scene)
        started -= shelf.spent_s
        budget = Budget(started, self._budget(len(known), context.budget_s))
        found = self._search(data, known, self.settings, self.searches, budget, self.clutter, shelf)
        if self.look_for_edges:
            found, held = self._beside_edges(data, known, found, held, shelf, budget)
        self.weights = weights(found)
        self.members = [PhasedPosterior(held, member.phased, self.noise_floor) for member in found]
        self.query = Query(self.members)
        counts = ", ".join(str(len(member.scene.words)) for member in self.members)
        agree = agreed([member.left_out for member in found], self.noise_floor)
        ended = "more would agree" if agree else f"within {budget.seconds:.0f} s"
        notes.append(f"{self.name}: {len(found)} of {self.searches} searches ({ended}), {counts} sources")
        scene = self.members[0].scene
        told = Counter(kinds(scene.sources, box_of(held, scene.transmitter)))
        told[SourceKind.EDGE] = len(self.edges)
        notes.append(f"{self.name}: the best search has " + ", ".join(f"{told[k]} {k}s" for k in SourceKind))
        clutter = scene.clutter
        if len(clutter):
            these = f"{len(clutter.boxes)} occluding boxes, {len(clutter.patches)} finite mirrors"
            notes.append(f"{self.name}: clutter: {these}")
        return FitReport(time.monotonic() - started, tuple(notes))

    def _key(self, data: Measurements, known: np.ndarray) -> str:
        """What searches depend on; how long they may take and how many there are is not part of it."""
        facts = (data.site.sha256, self.search_rows, self.row_limit, self.offsets, self.clutter, self.seed)
        return sha256(f"{facts} {self.settings} ".encode() + known.tobytes()).hexdigest()[:24]

    def _budget(self, measurements: int, given_s: float | None) -> float:
        if given_s is not None:
            return given_s
        if self.budget_s is not None:
            return self.budget_s
        return min(max(SECONDS * measurements**1.5, LEAST_BUDGET_S), MOST_BUDGET_S)

    def _search(
        self,
        data: Measurements,
        known: np.ndarray,
        settings: SearchSettings,
        count: int,
        budget: Budget,
        furniture: bool = False,
        shelf: Shelf | None = None,
    ) -> list[Member]:
        draw = [self._inside(data, known, self.search_rows, self.seed + i) for i in range(count)]
        start = self._start(data.site)
        return search_many(draw, start, settings, self.seed, self.noise_floor, budget, furniture, shelf)

    def _beside_edges(
        self,
        data: Measurements,
        known: np.ndarray,
        found: list[Member],
        held: Rows,
        shelf: Shelf,
        budget: Budget,
    ) -> tuple[list[Member], Rows]:
        """Searches and rows without the edges that the likelihood wants; as they were when it wants none."""
        scene, rows = found[0].phased.scene, self._inside(data, known, self.search_rows, self.seed)
        start, generator = scene.transmitter, torch.Generator().manual_seed(self.seed)
        edges = find_edges(rows, scene, box_of(rows, start), generator, self.noise_floor)
        if not len(edges):
            return found, held
        log.info("%d edges; searching again without what they explain", len(edges))
        remaining = max(budget.seconds - budget.spent, AGAIN * budget.seconds)
        budget = Budget(time.monotonic(), remaining)
        draw = [self._inside(data, known, self.search_rows, self.seed + i) for i in range(self.searches)]
        draw = [without(part, edges, start) for part in draw]
        again = search_many(
            draw, self._start(data.site), self.settings, self.seed, self.noise_floor, budget,
            self.clutter, shelf, "beside edges",
        )  # fmt: skip
        power = float(draw[0].target.abs().square().mean())  # left-out errors are shares of it
        # the edges' own gains saw every row: only a clear gain counts
        if again[0].left_out * power > CLEARLY * found[0].left_out:
            return found, held
        scene = again[0].phased.scene
        self.edges = with_gains(held, edges.point, edges.axis, scene, self.noise_floor)
        return again, without(held, self.edges, scene.transmitter)

    def _inside(self, data: Measurements, known: np.ndarray, limit: int, seed: int) -> Rows:
        return self.frame.inside(gather(data, known, limit, seed))

    def _start(self, site: Site) -> Tensor:
        assert site.static_position is not None
        return torch.from_numpy(np.asarray(site.static_position, np.float64)) - self.frame.middle

    def _aligned(self, data: Measurements, known: np.ndarray) -> Measurements:
        """Offsets against the line of sight, then against ever more sources."""
        start = self._start(data.site)
        aligned = self._against(data, known, start[None], torch.ones(1, self.antennas))
        for sources in ALIGNING:
            few = replace(self.settings, max_sources=sources, final_steps=20)
            now = Budget(time.monotonic(), LEAST_BUDGET_S)
            phased = self._search(aligned, known, few, 1, now)[0].phased
            for _ in range(ALIGNMENTS):
                rows = self._inside(aligned, known, self.search_rows, self.seed)
                gains = PhasedPosterior(rows, phased, self.noise_floor).mean_gains
                aligned = self._against(data, known, phased.scene.sources, gains)
        return aligned

    def _against(self, data: Measurements, known: np.ndarray, sources: Tensor, gains: Tensor) -> Measurements:
        """Targets of the known rows without the offsets they have against sources of constant gains."""
        frequency = data.site.tones()
        places = elements(data.site, data.moving[known], data.rx_rotation[known], self.antennas)
        flat = torch.from_numpy(places.reshape(-1, 3).copy()) - self.frame.middle
        waves = wave_over_band(ranges(flat, sources), torch.from_numpy(frequency))
        if gains.shape[1] == 1 or places.shape[1] > 1:
            gains = gains[:, :1]
        summed = torch.einsum("mkf,kr->mrf", waves, gains.to(waves.dtype))
        predicted = summed.reshape(len(known), -1, len(frequency)).numpy()
        mask = None if data.mask is None else data.mask[known]
        carrier = self.frame.carrier_hz
        found = estimate(
            data.target[known], predicted, frequency, carrier, self.offsets == "phase_timing", mask
        )
        target = data.target.copy()
        target[known] = found.removed(data.target[known], frequency, carrier)
        return replace(data, target=target)

    # ---- predicting ----
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`.

        The variance is the posterior's plus the searches' spread; the confidence is the share of the power
        expected there that is known.
        """
        site = self._fitted()
        flat, count = self._places(tx, rx)
        per = len(flat) // count
        tones = torch.from_numpy(site.tones())
        stack, variance, prior = self.query.means(flat, tones)  # (members, B E, R, K)
        weight = self.weights[:, None, None, None]
        if len(self.edges):
            stack = stack + self.edges.over_band(flat, tones, self.members[0].scene.transmitter)
        mean = (weight * stack).sum(0)
        variance = variance + (weight * (stack - mean).abs().square()).sum(0).flatten(1).mean(1)
        loudness = (self.frame.carrier_hz / tones).float()
        mean = (mean * (loudness * self.frame.scale)).reshape(count, self.antennas, len(tones))
        variance, prior = (v.reshape(count, per).mean(1) for v in (variance, prior))
        return Prediction(
            mean,
            confidence=(1 - variance / prior).clamp(0, 1),
            variance=variance * self.frame.scale**2,
        )

    def paths(self, tx: Tensor, rx: Pose) -> tuple[Tensor, Tensor, Tensor, float]:
        """What `predict` sums: one path a source of every search, weighted as the searches are, and edges.

        Returns:
            Gains (B, A, N) complex64 at the carrier, in stored units; delays (B, A, N) float64 [s]; unit
            vectors (B, N, 3) float64 from the middle of the moving end's antennas to where a path comes from;
            the carrier [Hz].
        """
        flat, count = self._places(tx, rx)
        start, carrier = self.members[0].scene.transmitter, self.frame.carrier_hz
        middle = flat.view(count, -1, 3).mean(1)
        weight = torch.repeat_interleave(self.weights, torch.tensor(self.query.counts))
        away = ranges(flat, self.query.pack.sources)
        gain = self.query.gains(flat) * weight[:, None, None] * wave(away, carrier).T[..., None]
        towards = self.query.pack.sources - middle[:, None]
        if len(self.edges):
            length, met = diffracted(flat, self.edges, start)
            hertz = torch.full((len(flat),), carrier, dtype=torch.float64)
            waves = edge_wave(flat, self.edges.point, self.edges.axis, start, hertz)
            gain = torch.cat([gain, waves.T[..., None] * self.edges.gain[:, None]])
            away = torch.cat([away, length], 1)
            # every element meets an edge elsewhere: the middle of where they do
            met = met.view(count, -1, len(self.edges), 3).mean(1)
            towards = torch.cat([towards, met - middle[:, None]], 1)
        gain = (gain * self.frame.scale).movedim(0, -1).reshape(count, self.antennas, -1)
        delay = (away / LIGHT).view(count, -1, away.shape[1]).expand(-1, self.antennas, -1)
        return gain, delay, towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True), carrier

    def _places(self, tx: Tensor, rx: Pose) -> tuple[Tensor, int]:
        """Antennas of the moving end (B E, 3) float64 in the search's frame, and B."""
        site = self._fitted()
        if site.moving_end == "rx":
            places = query_elements(site, rx, len(tx), self.antennas)
        else:
            places = tx.detach().cpu().double().numpy()[:, None]
        return torch.from_numpy(places.reshape(-1, 3).copy()) - self.frame.middle, len(places)

    def leave_one_out(self) -> LeftOut:
        """Residuals (n, R) of receivers (n,), each predicted from all others; see `LeaveOneOut`."""
        self._fitted()
        rows, weight = self.members[0].rows, self.weights[:, None, None]
        said = (weight * torch.stack([member.left_out() for member in self.members])).sum(0)
        loud = (self.frame.carrier_hz / rows.frequency).float()[:, None] * self.frame.scale
        return LeftOut(rows.receiver.numpy(), (rows.target - said) * loud, self.offsets != "none")

    # ---- what it can do besides ----
    def resume_problem(self) -> str | None:
        """None: finished searches are kept in `last.ckpt`."""
        return None

    def knobs(self) -> tuple[str, ...]:
        """See `Reducible`."""
        return ("searches", "keep", "confidence")

    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """`contribution0`, `contribution1`, ... (K,): mean power of each search's sources at its rows."""
        return {
            f"contribution{i}": member.scene.log_amplitude.mul(2).exp() * member.waves.abs().square().mean(0)
            for i, member in enumerate(self.members)
        }

    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Reducible`."""
        return reduced(self, settings, measured)

    # ---- keeping ----
    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        self._fitted()
        rows = self.members[0].rows
        return {
            "antennas": self.antennas,
            "weights": self.weights,
            "noise_floor": self.noise_floor,
            "frame": [self.frame.middle, self.frame.scale, self.frame.carrier_hz],
            "rows": [rows.position, rows.frequency, rows.target, rows.receiver],
            "edges": [self.edges.point, self.edges.axis, self.edges.gain],
            "scenes": [_scene_state(member.phased) for member in self.members],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.antennas = site, int(state["antennas"])
        self.noise_floor = float(state["noise_floor"])
        self.weights = state["weights"]
        self.frame = Frame(*state["frame"])
        rows = Rows(*state["rows"])
        self.edges = Edges(*state["edges"]) if "edges" in state else Edges.none()
        self.members = [PhasedPosterior(rows, _scene(stored), self.noise_floor) for stored in state["scenes"]]
        self.query = Query(self.members)

    def size(self) -> int:
        """Sources of the largest scene."""
        return max((len(member.scene.words) for member in self.members), default=0) + len(self.edges)

    def _fitted(self) -> Site:
        if self.site is None or not self.members:
            raise ValueError("image_source_gp: not fitted yet; call fit or restore first")
        return self.site


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
        "boxes": scene.clutter.boxes,
        "patches": scene.clutter.patches,
        "patched": list(scene.clutter.plane),
    }


def _scene(state: dict[str, Any]) -> PhasedScene:
    scene = Scene(
        state["transmitter"],
        state["planes"],
        tuple(tuple(word) for word in state["words"]),
        state["log_amplitude"],
        float(state["log_noise"]),
        KernelVisibility(*state["visibility"]),
        Clutter(state["boxes"], state["patches"], tuple(state["patched"])),
    )
    return PhasedScene(scene, state["phase"], float(state["turning"]))
