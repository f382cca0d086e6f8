"""`model=image_source_gp`: channels from an ensemble of image-source searches, with a variance."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.data.splits import Fold
from gsparc.field.initial import Snapshot
from gsparc.models.closed_form import LeftOutRows, Moments, from_containers, to_containers
from gsparc.models.image_sources import ensemble
from gsparc.models.image_sources.element_factors import direct_path_scene, find_element_factors
from gsparc.models.image_sources.ensemble import Look, Member
from gsparc.models.image_sources.frame import (
    SourceFrame,
    SourcePaths,
    SourcesInFrame,
    require_fixed_rotation,
    require_static_phase,
)
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.offsets import remove_offsets
from gsparc.models.image_sources.query import VARIANCE_ROWS, EnsembleMeans
from gsparc.models.image_sources.refine import POLISHING_STEPS
from gsparc.models.image_sources.rows import (
    Rows,
    rows_of_measurements,
    static_array,
)
from gsparc.models.image_sources.scene import JITTER, SourceScene
from gsparc.models.image_sources.search import Found, SearchSettings
from gsparc.models.method import Method, Prediction
from gsparc.models.reduced import MeanOnly, Settings
from gsparc.physics.mirror_planes import hesse_form
from gsparc.physics.row_factors import UnknownFactor
from gsparc.physics.waves import point_wave
from gsparc.processes.averages import mixture_moments
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort
from gsparc.training.race import Race
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

ALIGNMENT_SOURCES = (8, 20)  # sources of the searches that phase offsets are estimated against
ALIGNMENT_ROUNDS = 3  # estimates of offsets and gains in turn, after each search
LOOKED_AT = 200  # rows of the group that a search leaves out, after each round
# Times the effort of a search beside others: here nothing else answers where it ends early
ALONE = 3.0


class ImageSourceGP(SourcesInFrame):
    """Image-source Gaussian process; one end stands still, both may have antennas of known places.

    Args:
        searches, search_rows, rows, margin, max_sources, order, offsets, clutter, seed: see
            `SearchSettings`.

    Constant complex factors of a static array's antennas are estimated
    where the likelihood wants them.

    Attributes:
        start: places [m], local, and amplitudes of sources that each search starts from, or None.

    Raises:
        SettingError: a setting that cannot be.
    """

    name = "image_source_gp"
    members: tuple[GainPosterior, ...] = ()
    _groups: tuple[np.ndarray, ...] = ()
    takes_effort = True
    start: Found | None = None

    def __init__(
        self,
        searches: int = SearchSettings.searches,
        search_rows: int = SearchSettings.search_rows,
        rows: int = SearchSettings.rows,
        margin: float = SearchSettings.margin,
        max_sources: int = SearchSettings.max_sources,
        order: int = SearchSettings.order,
        offsets: Snapshot = "none",
        clutter: bool = True,
        seed: int = 0,
    ) -> None:
        self.settings = SearchSettings(
            searches, search_rows, rows, margin, max_sources, order, offsets, clutter, seed
        )

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Search on `train` and `val` together: the number of sources is chosen by likelihood.

        Raises:
            ValueError: the data are not channels, or their phase means nothing.
        """
        require_static_phase(data.site, self.name)
        require_fixed_rotation(data)
        seen = fold.learned()
        self._groups = context.leave_out
        effort = Effort().scale_by(context.effort * (1.0 if context.leave_out else ALONE))
        watch, settings = Stopwatch(), self.settings
        self.site, antennas = data.site, data.target.shape[1]
        # The frame is of rows of all searches: their scenes are averaged in it.
        self.frame = SourceFrame.from_rows(
            data.site, antennas, rows_of_measurements(data, seen, settings.rows, settings.seed)
        )
        noise = 0.0 if data.noise_variance is None else float(np.mean(data.noise_variance[seen]))
        # Simulated channels may have no noise, and float32 needs some to factor.
        self.noise_floor = max(JITTER, noise / self.frame.scale**2)
        notes: list[str] = []
        self.factors = torch.ones(antennas, dtype=torch.complex64)
        calibrated = static_array(data.site, antennas) is not None and settings.offsets == "none"
        if calibrated:
            # Against the direct wave first, as a search needs aligned antennas;
            # again against what it found.
            start = self._draw_search_rows(data, seen, 0)
            data = self._calibrate_antennas(
                data,
                start,
                direct_path_scene(start, self._transmitter_in_frame(), self.noise_floor),
            )
        if settings.offsets != "none":
            data = self._align_offsets(data, seen, effort)
            notes.append(
                f"{self.name}: {settings.offsets} offset of every snapshot estimated; "
                "predictions have none"
            )
        row_sets = self._draw_row_sets(data, seen)
        look = None
        if self._groups and context.race is not None:
            # Search 0 is the one looked at, and it leaves out the first group (`_kept`).
            group = self._groups[0][:: -(-len(self._groups[0]) // LOOKED_AT)]
            look = partial(self._log_look, context.race, group, data.batch(group), [])
        warm_start = (
            None if self.start is None else (self.start[0] - self.frame.middle, self.start[1])
        )
        members = self._run_searches(row_sets, settings, effort, look, warm_start)
        if calibrated:
            again = self._calibrate_antennas(data, row_sets[members[0].number], members[0].scene)
            if again is not data:
                data, row_sets = again, self._draw_row_sets(again, seen)
                # Factors change little the second time: a refinement does, no other search.
                members = [
                    ensemble.refine_member(row_sets[member.number], member) for member in members
                ]
        rows = self._draw(data, seen)
        self._set_members(rows, members)
        self.held = self._predict_left_out(data, seen, members, len(rows))
        notes += self._describe_search(members)
        return FitReport(watch.seconds, tuple(notes))

    def _set_posteriors(self, rows: Rows, scenes: list[SourceScene]) -> None:
        """Set the processes, and what answers queries, from rows in the frame."""
        self.members = tuple(GainPosterior(rows, scene) for scene in scenes)
        self.query = EnsembleMeans(self.members)

    def _set_members(self, rows: Rows, members: list[Member]) -> ImageSourceGP:
        """Say what these members say, with their weights (M,) float32 of sum 1."""
        self._set_posteriors(rows, [member.scene for member in members])
        self.weights = ensemble.weights_of_fits(
            torch.tensor([member.left_out for member in members])
        )
        return self

    def _describe_search(self, members: list[Member]) -> list[str]:
        """What was found, and what ended the search."""
        scene = self.members[0].scene
        counts = ", ".join(str(len(member.scene.sequences)) for member in self.members)
        agree = ensemble.reached_noise_floor(
            [member.left_out for member in members], self.noise_floor
        )
        ended = "two agree up to noise, which is enough" if agree else "as many as effort= asks for"
        boxes, patches = len(scene.clutter.boxes), len(scene.clutter.patches)
        notes = [
            f"{len(members)} of {self.settings.searches} searches ({ended}) found {counts} sources"
        ]
        if boxes or patches:
            notes.append(f"clutter: {boxes} occluding boxes, {patches} finite mirrors")
        if (self.factors != 1).any():
            turned = (self.factors / self.factors[0]).angle().rad2deg().abs().max()
            notes.append(
                f"factors of the {len(self.factors)} antennas estimated, phases up to "
                f"{turned:.0f} degrees "
                "from the first's"
            )
        return [f"{self.name}: {note}" for note in notes]

    def _calibrate_antennas(
        self, data: Measurements, rows: Rows, scene: SourceScene
    ) -> Measurements:
        """Targets times the antennas' factors, which are kept;
        unchanged when they gain too little.
        """
        factors = find_element_factors(rows, scene)
        if factors is None:
            return data
        self.factors = self.factors * factors
        return replace(data, target=data.target * factors.numpy()[:, None])

    def _run_searches(
        self,
        row_sets: list[Rows],
        settings: SearchSettings,
        effort: Effort,
        look: Look | None = None,
        start: Found | None = None,
    ) -> list[Member]:
        """What `run_searches` finds about the static end, best first."""
        still, floor = self._transmitter_in_frame(), self.noise_floor
        return ensemble.run_searches(row_sets, still, settings, floor, effort, look, start)

    def _log_look(
        self,
        race: Race,
        group: np.ndarray,
        batch: Batch,
        errors: list[float],
        rows: Rows,
        scene: SourceScene,
        finished: bool,
    ) -> None:
        """Look at a search's scene by a batch of rows `group` (n,) that it left out;
        `FellBehind` ends it.
        """
        # On a copy: `predict` reads the method's own processes, which are not found yet.
        mean = copy.copy(self)._set_members(rows, [Member(scene, 1.0)]).predict(batch).mean
        # Predictions are in stored units, the batch's targets already times the factors.
        missed = mean - batch.target / self.factors[:, None]
        text = f"{len(scene.sequences)} sources"
        errors.append(race.check_candidate(text, group, missed, errors, finished))

    def _draw(
        self, data: Measurements, rows: np.ndarray, limit: int | None = None, number: int = 0
    ) -> Rows:
        """Some rows in the frame, drawn with the seed of a search by its number."""
        limit = self.settings.rows if limit is None else limit
        return self.frame.normalise(
            rows_of_measurements(data, rows, limit, self.settings.seed + number)
        )

    def _draw_search_rows(self, data: Measurements, known: np.ndarray, number: int) -> Rows:
        """Rows of a search by its number."""
        return self._draw(
            data, self._rows_of_search(known, number), self.settings.search_rows, number
        )

    def _draw_row_sets(self, data: Measurements, known: np.ndarray) -> list[Rows]:
        """Rows of each search."""
        return [
            self._draw_search_rows(data, known, number) for number in range(self.settings.searches)
        ]

    def _rows_of_search(self, known: np.ndarray, number: int) -> np.ndarray:
        """What a search by its number learns from: all but the group whose turn it is."""
        groups = self._groups
        return np.setdiff1d(known, groups[number % len(groups)]) if groups else known

    def _predict_left_out(
        self, data: Measurements, known: np.ndarray, members: list[Member], limit: int
    ) -> LeftOutRows | None:
        """Rows of every group predicted by the searches that left it out,
        from at most `limit` others.
        """
        rows, answers = [], []
        for turn, group in enumerate(self._groups):
            if mine := [member for member in members if member.number % len(self._groups) == turn]:
                # As many rows as the process that answers has: fewer would err more than it does.
                others = self._draw(data, self._rows_of_search(known, turn), limit)
                of_searches = copy.copy(self)._set_members(others, mine)
                rows.append(group)
                answers.append(of_searches.predict(data.batch(group)))
        if not rows:
            return None
        joint = Prediction.joined(answers)
        assert joint.variance is not None
        return LeftOutRows(np.concatenate(rows), joint.mean, joint.variance)

    def _transmitter_in_frame(self) -> Tensor:
        assert self.site is not None and self.site.static_position is not None
        return (
            torch.from_numpy(np.asarray(self.site.static_position, np.float64)) - self.frame.middle
        )

    def _align_offsets(self, data: Measurements, known: np.ndarray, effort: Effort) -> Measurements:
        """Estimate offsets against the line of sight, then against more and more sources."""
        direct = SourceScene.from_static_end(self._transmitter_in_frame(), torch.zeros(1))
        free: UnknownFactor = "phase" if self.settings.offsets == "phase" else "phase+delay"
        remove = partial(remove_offsets, middle=self.frame.middle, free=free)
        aligned = remove(data, known, direct, torch.ones(1, self.frame.antennas))
        for sources in ALIGNMENT_SOURCES:
            few = replace(
                self.settings, max_sources=sources, final_steps=POLISHING_STEPS, clutter=False
            )
            rows = self._draw_search_rows(aligned, known, 0)
            scene = self._run_searches([rows], few, effort)[0].scene
            for _ in range(ALIGNMENT_ROUNDS):
                gains = GainPosterior(self._draw_search_rows(aligned, known, 0), scene).mean_gains
                aligned = remove(data, known, scene, gains)
        return aligned

    def _predict_normalised(self, places: Tensor, tones: Tensor, float64: bool) -> Moments:
        """See `SourcesInFrame`; the variance is the posterior's plus that of the ensemble."""
        stack, variance, prior = (self.query.in_float64 if float64 else self.query).predict(
            places, tones
        )
        parts = [
            (share, mean, variance)
            for share, mean in zip(self.weights.tolist(), stack, strict=True)
        ]
        return Moments(*mixture_moments(parts), prior)

    def _normalised_paths(self, places: Tensor) -> SourcePaths:
        """See `SourcesInFrame`."""
        weight = torch.repeat_interleave(self.weights, torch.tensor(self.query.counts))
        away = self.query.ranges(places)
        gain = self.query.gains(places) * weight[:, None, None]
        gain = gain * point_wave(away, self.frame.carrier_hz).T[..., None]
        return SourcePaths(gain.movedim(0, -1), away, self.query.sources)

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """Return receivers, each predicted from all others."""
        frame = self._fitted_frame()
        each = torch.stack([member.predict_left_out() for member in self.members])
        predicted = (self.weights[:, None, None] * each).sum(0)
        return frame.to_left_out_rows(self.members[0].rows, predicted)

    def reduction_settings(self) -> tuple[str, ...]:
        """See `Method.reduction_settings`."""
        return ("searches", "confidence")

    @torch.no_grad()
    def reduce(self, settings: Settings, measured: dict[str, Tensor]) -> Method:
        """See `Method.reduce`: `searches` of largest weight, no variance;
        no source can be spared.
        """
        twin = copy.copy(self)
        count = min(int(settings.get("searches", len(self.members))), len(self.members))
        chosen = self.weights.topk(count).indices.sort().values
        twin.weights = self.weights[chosen] / self.weights[chosen].sum()
        twin.members = tuple(self.members[i] for i in chosen.tolist())
        whole = settings.get("confidence", True)
        twin.query = EnsembleMeans(twin.members, VARIANCE_ROWS if whole else 0)
        return twin if whole else MeanOnly(twin)

    def state(self) -> dict[str, Any]:
        """See `Method.state`."""
        return {
            "frame": self._fitted_frame().state(),
            "factors": self.factors,
            "weights": self.weights,
            "rows": to_containers(self.members[0].rows),
            "scenes": [to_containers(member.scene) for member in self.members],
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, self.frame = site, SourceFrame(site, **state["frame"])
        self.factors, self.weights = state["factors"], state["weights"]
        self._set_posteriors(
            from_containers(Rows, state["rows"]),
            [from_containers(SourceScene, scene) for scene in state["scenes"]],
        )

    @property
    def terms(self) -> tuple[str, ...]:
        """Carrier phase, and visibility where it is modelled."""
        return (
            ("phase", "visibility")
            if any(len(member.scene.clutter) for member in self.members)
            else ("phase",)
        )

    def objects(self) -> SiteObjects:
        """Return planes and boxes of the heaviest search."""
        scene, middle = self.members[int(self.weights.argmax())].scene, self.frame.middle.double()
        normal, offset = hesse_form(scene.planes.double())
        # n.p = b about the frame's middle m is n.p = b + n.m in local coordinates.
        moved = torch.cat([normal, offset + (normal @ middle)[:, None]], 1)
        boxes = scene.clutter.boxes.double().unflatten(1, (2, -1)) + middle
        return SiteObjects.from_arrays(moved.numpy(), boxes.numpy())

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ClosedForm`; offsets of snapshots were estimated with the gains, which stay."""
        if self.settings.offsets == "none":
            data = replace(data, target=data.target * self.factors.numpy()[:, None])
            self._set_posteriors(self._draw(data, rows), [member.scene for member in self.members])

    def count_components(self) -> int:
        """Return the number of sources of the largest scene."""
        return max((len(member.scene.sequences) for member in self.members), default=0)
