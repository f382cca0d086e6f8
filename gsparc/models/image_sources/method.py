"""`model=image_source_gp`: channels from an ensemble of image-source searches, with a variance."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from hashlib import sha256
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.assemble import identity
from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.models.closed_form import LeftOutRows
from gsparc.models.image_sources import ensemble
from gsparc.models.image_sources.element_factors import direct_path, element_factors
from gsparc.models.image_sources.frame import Frame, SourcesInFrame, refuse, refuse_turning
from gsparc.models.image_sources.gp_likelihood import Posterior
from gsparc.models.image_sources.phase_offsets import Offsets, estimate
from gsparc.models.image_sources.query import VARIANCE_ROWS, Means
from gsparc.models.image_sources.rows import Rows, gather, measured_places, ranges_at, static_array
from gsparc.models.image_sources.scene import Scene
from gsparc.models.image_sources.search import Found, SearchSettings
from gsparc.models.image_sources.search_cache import Member, SearchCache
from gsparc.models.method import Method
from gsparc.models.pareto import Settings
from gsparc.models.plain import made, plain
from gsparc.models.reduced import MeanOnly
from gsparc.physics.mirror_planes import orientations
from gsparc.physics.waves import wave, wave_over_band
from gsparc.training.context import FitContext, FitReport
from gsparc.training.race import Race
from gsparc.training.time_budget import TimeBudget, less_repeatable

log = logging.getLogger(__name__)

ALIGNMENT_SOURCES = (8, 20)  # sources of the searches that phase offsets are estimated against
ALIGNMENT_ROUNDS = 3  # estimates of offsets and gains in turn, after each search
LOOKED_AT = 200  # rows of the group that a search leaves out, after each round
ALONE = 3.0  # times the effort of a search beside others: here nothing else answers where it ends early


class ImageSourceGP(SourcesInFrame):
    """Image-source Gaussian process; one end stands still, both may have antennas of known places.

    Args:
        budget_s: as `FitContext.budget_s`, where that says nothing [s].
        searches, search_rows, rows, margin, max_sources, order, offsets, clutter, seed: see `SearchSettings`.
        start: places [m], local, and amplitudes of sources that a search of these measurements starts from.

    Constant complex factors of a static array's antennas are estimated where the likelihood wants them.

    Raises:
        SettingError: a setting that cannot be.
    """

    name = "image_source_gp"
    members: tuple[Posterior, ...] = ()
    _groups: tuple[np.ndarray, ...] = ()
    resumable = True  # finished searches are kept in `last.ckpt`
    takes_budget = True

    def __init__(
        self, searches: int = 6, budget_s: float | None = None, search_rows: int = 700, rows: int = 3000,
        margin: float = 8.0, max_sources: int = 60, order: int = 3, offsets: Offsets = "none",
        clutter: bool = True, seed: int = 0, start: Callable[[Measurements, np.ndarray], Found] | None = None,
    ) -> None:  # fmt: skip
        self.budget_s, self._start = budget_s, start
        self.settings = SearchSettings(
            searches, search_rows, rows, margin, max_sources, order, offsets, clutter, seed
        )

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Search on `train` and `val` together: the number of sources is chosen by likelihood.

        Raises:
            ValueError: the data are not channels, or their phase means nothing.
            KeyboardInterrupt: by the user; the message names the file to go on from.
        """
        refuse(data.site, self.name)
        refuse_turning(data)
        known = np.concatenate([fold.train, fold.val])
        self._groups = context.leave_out
        cache = SearchCache(context.run_dir, context.resume, self._depends_on(data, known))
        try:
            return self._fit(data, known, context, cache)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(cache.interrupted()) from None

    def _fit(
        self, data: Measurements, known: np.ndarray, context: FitContext, cache: SearchCache
    ) -> FitReport:
        budget_s = self.budget_s if context.budget_s is None else context.budget_s
        effort = context.effort * (1.0 if context.leave_out else ALONE)
        context = replace(context, budget_s=budget_s, effort=effort)
        budget, settings = context.time_budget(cache.spent), self.settings
        self.site, antennas = data.site, data.target.shape[1]
        # The frame is of rows of all searches: their scenes are averaged in it.
        self.frame = Frame.of(data.site, antennas, gather(data, known, settings.rows, settings.seed))
        noise = 0.0 if data.noise_variance is None else float(np.mean(data.noise_variance[known]))
        # -50 dB of the rows' power: simulated channels may have no noise, and float32 needs some to factor.
        self.noise_floor = max(1e-5, noise / self.frame.scale**2)
        notes: list[str] = []
        self.factors = torch.ones(antennas, dtype=torch.complex64)
        calibrated = static_array(data.site, antennas) is not None and settings.offsets == "none"
        if calibrated:
            # Against the direct wave first, as a search needs aligned antennas; again against what it found.
            start = self._searched_rows(data, known, 0)
            data = self._calibrated(data, start, direct_path(start, self._transmitter(), self.noise_floor))
        if settings.offsets != "none":
            data = self._without_offsets(data, known, budget)
            notes.append(
                f"{self.name}: {settings.offsets} offset of every snapshot estimated; predictions have none"
            )
        row_sets = self._row_sets(data, known)
        look = None
        if self._groups and context.race is not None:
            # Search 0 is the one looked at, and it leaves out the first group (`_kept`).
            group = self._groups[0][:: -(-len(self._groups[0]) // LOOKED_AT)]
            look = partial(self._looked, context.race, group, data.batch(group), [math.inf])
        members = self._search(row_sets, settings, budget, cache, look, partial(self._found, data, known))
        if calibrated:
            again = self._calibrated(data, row_sets[members[0].number], members[0].scene)
            if again is not data:
                data, row_sets = again, self._row_sets(again, known)
                # Factors change little the second time: a refinement does, no other search.
                members = [ensemble.refined(row_sets[one.number], one) for one in members]
        rows = self._rows(data, known)
        self._become(rows, members)
        self.held = self._left_out_rows(data, known, members, len(rows))
        notes += self._described(members, budget)
        limited = less_repeatable(budget.limited_by, cache.limited_by)
        return FitReport(budget.counted.wall, tuple(notes), limited)

    def _conditioned(self, rows: Rows, scenes: list[Scene]) -> None:
        """Set the processes, and what answers queries, from rows in the frame."""
        self.members = tuple(Posterior(rows, scene) for scene in scenes)
        self.query = Means(self.members)

    def _become(self, rows: Rows, members: list[Member]) -> ImageSourceGP:
        """Say what these members say, with their weights."""
        self._conditioned(rows, [member.scene for member in members])
        self.weights = ensemble.weights_of(members)
        return self

    def _described(self, members: list[Member], budget: TimeBudget) -> list[str]:
        """What was found, and what ended the search."""
        scene = self.members[0].scene
        counts = ", ".join(str(len(member.scene.sequences)) for member in self.members)
        agree = ensemble.at_noise_floor([member.left_out for member in members], self.noise_floor)
        ended = "noise floor reached" if agree else "all counted"
        ended = "ended by the time budget" if budget.limited else ended
        inside = int(scene.scatterers(self.members[0].rows).sum())
        boxes, patches = len(scene.clutter.boxes), len(scene.clutter.patches)
        notes = [
            f"{len(members)} of {self.settings.searches} searches ({ended}), {counts} sources",
            f"the best search has {len(scene.sequences) - inside} images, {inside} scatterers",
        ]
        if boxes or patches:
            notes.append(f"clutter: {boxes} occluding boxes, {patches} finite mirrors")
        if (self.factors != 1).any():
            turned = (self.factors / self.factors[0]).angle().rad2deg().abs().max()
            notes.append(
                f"factors of the {len(self.factors)} antennas estimated, phases up to {turned:.0f} degrees "
                "from the first's"
            )
        return [f"{self.name}: {note}" for note in notes]

    def _calibrated(self, data: Measurements, rows: Rows, scene: Scene) -> Measurements:
        """Targets times the antennas' factors, which are kept; unchanged when they gain too little."""
        factors = element_factors(rows, scene)
        if factors is None:
            return data
        self.factors = self.factors * factors
        return replace(data, target=data.target * factors.numpy()[:, None])

    def _depends_on(self, data: Measurements, known: np.ndarray) -> dict[str, str]:
        """What a search depends on; neither the budget nor the number of searches."""
        rows = sha256(b"".join(part.tobytes() for part in (known, *self._groups))).hexdigest()
        # Search number n is the same however many there are: a resumed run may ask for more.
        settings = replace(self.settings, searches=1, seed=0)
        seed = str(self.settings.seed)
        told = f"{settings}, {'alone' if self._start is None else 'from directions'}"
        return {"data": identity(data), "rows": rows, "seed": seed, "settings": told}

    def _search(
        self, row_sets: list[Rows], settings: SearchSettings, budget: TimeBudget, cache: SearchCache,
        *more: Any,
    ) -> list[Member]:  # fmt: skip
        still, floor = self._transmitter(), self.noise_floor
        return ensemble.search_many(row_sets, still, settings, floor, budget, cache, *more)

    def _found(self, data: Measurements, known: np.ndarray, number: int) -> Found | None:
        """What a search by its number starts from, in the frame."""
        if self._start is None or data.directions is None:
            return None
        places, amplitude = self._start(data, self._kept(known, number))
        return places - self.frame.middle, amplitude

    def _looked(
        self, race: Race, group: np.ndarray, batch: Batch, errors: list[float], rows: Rows, scene: Scene
    ) -> None:
        """Look at a search's scene by a batch of rows `group` (n,) that it left out; `Behind` ends it."""
        # On a copy: `predict` reads the method's own processes, which are not found yet.
        mean = copy.copy(self)._become(rows, [Member(scene, 1.0)]).predict(batch).mean
        # Predictions are in stored units, the batch's targets already times the factors.
        missed = mean - batch.target / self.factors[:, None]
        errors.append(race.looked(f"{len(scene.sequences)} sources", group, missed, errors[-1]))

    def _rows(self, data: Measurements, index: np.ndarray, most: int | None = None, number: int = 0) -> Rows:
        """Some rows in the frame, drawn with the seed of a search by its number."""
        most = self.settings.rows if most is None else most
        return self.frame.inside(gather(data, index, most, self.settings.seed + number))

    def _searched_rows(self, data: Measurements, known: np.ndarray, number: int) -> Rows:
        """Rows of a search by its number."""
        return self._rows(data, self._kept(known, number), self.settings.search_rows, number)

    def _row_sets(self, data: Measurements, known: np.ndarray) -> list[Rows]:
        """Rows of each search."""
        return [self._searched_rows(data, known, number) for number in range(self.settings.searches)]

    def _kept(self, known: np.ndarray, number: int) -> np.ndarray:
        """What a search by its number learns from: all but the group whose turn it is."""
        groups = self._groups
        return np.setdiff1d(known, groups[number % len(groups)]) if groups else known

    def _left_out_rows(
        self, data: Measurements, known: np.ndarray, members: list[Member], most: int
    ) -> LeftOutRows | None:
        """Rows of every group predicted by the searches that left it out, from at most `most` others."""
        rows, means = [], []
        for turn, group in enumerate(self._groups):
            if mine := [one for one in members if one.number % len(self._groups) == turn]:
                # As many rows as the process that answers has: fewer would err more than it does.
                apart = self._rows(data, self._kept(known, turn), most)
                rows.append(group)
                means.append(copy.copy(self)._become(apart, mine).predict(data.batch(group)).mean)
        if not rows:
            return None
        mean = torch.cat(means)
        return LeftOutRows(np.concatenate(rows), mean, torch.full((len(mean),), float("nan")))

    def _transmitter(self) -> Tensor:
        assert self.site is not None and self.site.static_position is not None
        return torch.from_numpy(np.asarray(self.site.static_position, np.float64)) - self.frame.middle

    def _without_offsets(self, data: Measurements, known: np.ndarray, budget: TimeBudget) -> Measurements:
        """Estimate offsets against the line of sight, then against more and more sources."""
        direct = Scene.direct(self._transmitter(), torch.zeros(1))
        aligned = self._remove_offsets(data, known, direct, torch.ones(1, self.frame.antennas))
        for sources in ALIGNMENT_SOURCES:
            few = replace(self.settings, max_sources=sources, final_steps=20, clutter=False)
            rows = self._searched_rows(aligned, known, 0)
            scene = self._search([rows], few, budget, SearchCache())[0].scene
            for _ in range(ALIGNMENT_ROUNDS):
                gains = Posterior(self._searched_rows(aligned, known, 0), scene).mean_gains
                aligned = self._remove_offsets(data, known, scene, gains)
        return aligned

    def _remove_offsets(
        self, data: Measurements, known: np.ndarray, scene: Scene, gains: Tensor
    ) -> Measurements:
        """Targets of the known rows without their offsets against a scene's sources of constant gains."""
        frequency, carrier = data.site.tones(), self.frame.carrier_hz
        places = measured_places(data, known).clone()
        places[..., :3] -= self.frame.middle
        turned = orientations(scene.planes, scene.sequences)
        away = ranges_at(places.flatten(0, 1), scene.sources, turned)
        waves = wave_over_band(away, torch.from_numpy(frequency))
        # Antennas of known places share the gains; those of unknown ones each have their own.
        if gains.shape[1] == 1 or places.shape[1] > 1:
            gains = gains[:, :1]
        summed = torch.einsum("mkf,kr->mrf", waves, gains.to(waves.dtype))
        predicted = summed.reshape(len(known), -1, len(frequency)).numpy()
        mask, timing = None if data.mask is None else data.mask[known], self.settings.offsets != "phase"
        offsets = estimate(data.target[known], predicted, frequency, carrier, timing, mask)
        target = data.target.copy()
        target[known] = offsets.removed(data.target[known], frequency, carrier)
        return replace(data, target=target)

    def _answer(self, places: Tensor, tones: Tensor, exact: bool) -> tuple[Tensor, Tensor, Tensor]:
        """See `SourcesInFrame`; the variance is the posterior's plus that of the ensemble."""
        stack, variance, prior = (self.query.exact if exact else self.query).means(places, tones)
        weight = self.weights[:, None, None, None]
        mean = (weight * stack).sum(0)  # of (members, B E, R, K)
        return mean, variance + (weight * (stack - mean).abs().square()).sum(0).flatten(1).mean(1), prior

    def _paths(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `SourcesInFrame`."""
        weight = torch.repeat_interleave(self.weights, torch.tensor(self.query.counts))
        away = self.query.ranges(places)
        gain = self.query.gains(places) * weight[:, None, None]
        gain = gain * wave(away, self.frame.carrier_hz).T[..., None]
        return gain.movedim(0, -1), away, self.query.sources

    def left_out(self) -> LeftOutRows:
        """Return receivers, each predicted from all others."""
        frame = self._fitted()
        each = torch.stack([member.left_out() for member in self.members])
        predicted = (self.weights[:, None, None] * each).sum(0)
        return frame.left_out(self.members[0].rows, predicted)

    def knobs(self) -> tuple[str, ...]:
        """See `Method.knobs`."""
        return ("searches", "keep", "confidence")

    def contributions(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Return `contribution0`, `contribution1`, ... (K,): mean power of each search's sources at rows."""
        return {
            f"contribution{i}": member.scene.log_amplitude.mul(2).exp() * member.waves.abs().square().mean(0)
            for i, member in enumerate(self.members)
        }

    @torch.no_grad()
    def reduced(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Method.reduced`: `searches` of largest weight, a share of their sources (`keep`), no variance.

        The gains of the remaining sources are fitted anew: one factorisation here, nothing at queries.
        """
        twin = copy.copy(self)
        count = min(int(settings.get("searches", len(self.members))), len(self.members))
        chosen = self.weights.topk(count).indices.sort().values
        twin.weights = self.weights[chosen] / self.weights[chosen].sum()
        kept, share = {i: self.members[i] for i in chosen.tolist()}, settings.get("keep")
        if share is not None:
            kept = {i: _loudest(one, float(share), measured[f"contribution{i}"]) for i, one in kept.items()}
        twin.members = tuple(kept.values())
        whole = settings.get("confidence", True)
        twin.query = Means(twin.members, VARIANCE_ROWS if whole else 0)
        return twin if whole else MeanOnly(twin)

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {
            "frame": self._fitted().state(),
            "factors": self.factors,
            "weights": self.weights,
            "rows": plain(self.members[0].rows),
            "scenes": [plain(member.scene) for member in self.members],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.frame = site, Frame(site, **state["frame"])
        self.factors, self.weights = state["factors"], state["weights"]
        self._conditioned(made(Rows, state["rows"]), [made(Scene, scene) for scene in state["scenes"]])

    @property
    def terms(self) -> tuple[str, ...]:
        """Carrier phase, and visibility where it is modelled."""
        return ("phase", "visibility") if any(len(one.scene.clutter) for one in self.members) else ("phase",)

    def objects(self) -> SiteObjects:
        """Return planes and boxes of the heaviest search."""
        scene, middle = self.members[int(self.weights.argmax())].scene, self.frame.middle.double()
        planes = scene.planes.double()
        normal = planes[:, :3] / torch.linalg.vector_norm(planes[:, :3], dim=1, keepdim=True)
        # n.p = b about the frame's middle m is n.p = b + n.m in local coordinates.
        moved = torch.cat([normal, planes[:, 3:] + (normal @ middle)[:, None]], 1)
        boxes = scene.clutter.boxes.double().view(-1, 2, 3) + middle
        return SiteObjects.of(moved.numpy(), boxes.numpy())

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; offsets of snapshots were estimated with the gains, which stay."""
        if self.settings.offsets == "none":
            data = replace(data, target=data.target * self.factors.numpy()[:, None])
            self._conditioned(self._rows(data, rows), [member.scene for member in self.members])

    def size(self) -> int:
        """Return the number of sources of the largest scene."""
        return max((len(member.scene.sequences) for member in self.members), default=0)


def _loudest(member: Posterior, share: float, contribution: Tensor) -> Posterior:
    """A search with the sources that contribute (K,) most, and the transmitter, where all sequences start."""
    count = max(1, math.ceil(share * len(contribution)))
    loudest = sorted({0, *contribution.topk(count).indices.tolist()})
    return Posterior(member.rows, member.scene.only(loudest))
