"""Search for image sources: greedy, over reflections in known planes first,
over free space second.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import get_args

import torch
from torch import Tensor

from gsparc.base.limits import POSITIVE, Checked, choice, setting, switch, whole
from gsparc.field.initial import InitSettings, Snapshot
from gsparc.models.image_sources import reflection_orders as orders
from gsparc.models.image_sources.backprojection import (
    find_sources_in_box,
    score_candidates,
    select_separated,
)
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.refine import (
    POLISHING_STEPS,
    ROUND_STEPS,
    VISIBILITY_STEPS,
    learn_visibility,
    refine_scene,
)
from gsparc.models.image_sources.rows import LEAST_ROWS, Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene, direct_amplitude
from gsparc.physics.mirror_planes import Reflections, bisector, reflect
from gsparc.physics.waves import LIGHT
from gsparc.processes.worker import out_of_steps

log = logging.getLogger(__name__)

NOISE = 0.1  # variance at the start, of unit signal power
PARENTS = 4  # of a new source, tried in turn until one is found
# Least of a sequence over known planes, of a source with its own
SEQUENCE_SCORE, FREE_SCORE = 8.0, 15.0
SEQUENCES_PER_ROUND, FREE_PER_ROUND = 4, 2  # new sources, at most
PRUNE = 5.0  # least gain of a source kept [nats]
Found = tuple[Tensor, Tensor]  # places and amplitudes of sources
# Rounds without a gain of a source's nats, that end the search
PATIENCE, PROGRESS = 3, SEQUENCE_SCORE
REARRANGED_EVERY = 3  # rounds between attempts at walls, and at the visibility's lengths
LEARN_VISIBILITY_FROM = 12  # sources, from which on the visibility's lengths are learned


@dataclass(frozen=True)
class SearchSettings(Checked):
    """What is searched for, on which rows, and how far.

    Attributes:
        searches: how many, with different seeds; their predictions are averaged.
        search_rows: receivers times tones of a search.
        rows: receivers times tones of the final process.
        margin: of the search box around receivers and transmitter [m].
        max_sources: that end the search.
        order: largest reflection order of a source.
        offsets: unknown offsets of every snapshot, to be estimated: `none`, `phase` or
            `phase_timing`.
        clutter: search for occluding boxes and finite mirrors, shared by all sources.
        seed: of everything random in the first search; the others count on.
        final_steps: of refinement at the end.
    """

    searches: int = setting(6, whole(1))
    search_rows: int = setting(InitSettings.search_rows, whole(LEAST_ROWS))
    rows: int = setting(InitSettings.rows, whole(LEAST_ROWS))
    margin: float = setting(InitSettings.margin, POSITIVE)
    max_sources: int = setting(InitSettings.max_sources, whole(1))
    order: int = setting(orders.ORDER, whole(0))
    offsets: Snapshot = setting("none", choice(*get_args(Snapshot)))
    clutter: bool = setting(True, switch())
    seed: int = 0
    final_steps: int = 80


class Search:
    """One search over one set of normalised rows (`Frame`); if `out_of_steps`,
    with what was found so far.

    Args:
        rows: a few hundred.
        transmitter: (3,) float64 [m].
        settings: how.
        number: of the search, added to the seed of the candidates.
        after_round: called after every round; no other starts when it says so.
        found: places (K, 3) float64 [m] of sources to start from, and their amplitudes (K,).
    """

    def __init__(
        self,
        rows: Rows,
        transmitter: Tensor,
        settings: SearchSettings,
        number: int,
        after_round: Callable[[], bool],
        found: Found | None = None,
    ) -> None:
        self.rows, self.settings, self.after_round = rows, settings, after_round
        self.generator = torch.Generator().manual_seed(settings.seed + number)
        self.wavelength = LIGHT / float(rows.frequency.mean())
        measured = torch.cat([rows.position, transmitter[None]])
        self.box = torch.stack(
            [measured.amin(0) - settings.margin, measured.amax(0) + settings.margin]
        )
        loudness = direct_amplitude(rows, transmitter).log().reshape(1)
        self.scene = SourceScene.from_static_end(transmitter, loudness, math.log(NOISE))
        if found is not None and settings.order:
            places, amplitude = (each[: settings.max_sources - 1] for each in found)
            images = (places - transmitter).norm(dim=1) > 2 * orders.MIN_IMAGE_SHIFT_M
            planes = bisector(transmitter, places[images])
            words: list[Reflections] = [(i,) for i in range(len(planes))]
            self.scene = replace(self.scene, planes=planes).add_sequences(words, amplitude[images])

    def run(self) -> SourceScene:
        """Search until no source is accepted, then refine."""
        s, stale, best = self.settings, 0, math.inf
        self._refine(ROUND_STEPS)
        self._try_paired_walls()  # among sources that it starts from
        for number in count():
            added = self._add_sequences()
            free = not added
            if free:
                added = self._add_free_sources()
            if not added or self.after_round():
                break
            self._refine(ROUND_STEPS)
            if free or number % 2:
                self.scene = orders.drop_planes(self.rows, self.scene, 2 * self.wavelength)
            if number > 1 and number % REARRANGED_EVERY == 1:
                self._try_paired_walls()
            if number % 2:
                self.scene = orders.prune_sources(self.rows, self.scene, PRUNE)
            if number % REARRANGED_EVERY == 2:
                self._learn_visibility(6)
            nll = GainPosterior(self.rows, self.scene).nll
            log.debug(
                "round %d: %d sources, %d planes, nll %.1f, %s",
                number,
                len(self.scene.sequences),
                len(self.scene.planes),
                nll,
                self.scene.visibility,
            )
            if len(self.scene.sequences) >= s.max_sources:
                break
            stale, best = (0, nll) if nll < best - PROGRESS else (stale + 1, best)
            if stale >= PATIENCE:
                break
        return self._finish_scene()

    def _finish_scene(self) -> SourceScene:
        self._refine(POLISHING_STEPS)
        self._try_paired_walls()
        self._try_walls(orders.find_orthogonal_walls(self.scene))
        self.scene = orders.drop_planes(self.rows, self.scene, 3 * self.wavelength)
        self._add_sequences()
        self._refine(ROUND_STEPS)
        self.scene = orders.prune_sources(self.rows, self.scene, PRUNE)
        self._learn_visibility(VISIBILITY_STEPS)
        self._refine(self.settings.final_steps)
        return self.scene

    def _refine(self, steps: int) -> None:
        self.scene = refine_scene(self.rows, self.scene, steps)

    def _learn_visibility(self, steps: int) -> None:
        if len(self.scene.sequences) >= LEARN_VISIBILITY_FROM:
            few = self.rows.select_rows(
                torch.randperm(len(self.rows), generator=self.generator)[:400]
            )
            self.scene = learn_visibility(few, self.scene, KernelVisibility(), steps)

    def _add_sequences(self, limit: int | None = None) -> int:
        """Add the best reflections in known planes; returns how many."""
        scene, limit = self.scene, limit or SEQUENCES_PER_ROUND
        more = scene.replace_sequences(scene.longer_sequences(self.settings.order))
        if not more.sequences:
            return 0
        scores, amplitude = score_candidates(
            GainPosterior(self.rows, scene), more.images(self.rows)
        )
        spacing = 0.5 * self.wavelength
        chosen = select_separated(
            more.sources, scores, spacing, limit, SEQUENCE_SCORE, scene.sources
        )
        if chosen:
            self.scene = scene.add_sequences([more.sequences[i] for i in chosen], amplitude[chosen])
        return len(chosen)

    def _add_free_sources(self) -> int:
        """Add the best sources anywhere in the box, each with a plane of its own; returns how many.

        Images of several antennas are turned as their parent's are: with an array,
        parents are tried in turn.
        """
        posterior = GainPosterior(self.rows, self.scene)
        parents: list[Reflections | None] = (
            [None] if self.rows.array is None else [*self._strong_parents()]
        )
        for number, parent in enumerate(parents):
            if number and out_of_steps():
                break
            spread = partial(self._antenna_images, parent)
            spacing = 0.5 * self.wavelength
            sources = find_sources_in_box(
                posterior, self.box, spacing, FREE_PER_ROUND, self.generator, spread
            )
            sources = [source for source in sources if source[1] >= FREE_SCORE]
            for position, _, amplitude in sources:
                sequence, plane = self._best_parent_and_plane(position, posterior)
                planes = torch.cat([self.scene.planes, plane[None]])
                self.scene = replace(self.scene, planes=planes).add_sequences(
                    [(*sequence, len(planes) - 1)], amplitude[None]
                )
            if sources:
                return len(sources)
        return 0

    def _reflectable(self, scene: SourceScene) -> list[int]:
        """Sources that may be reflected once more."""
        return [
            i for i, sequence in enumerate(scene.sequences) if len(sequence) < self.settings.order
        ]

    def _strong_parents(self) -> list[Reflections]:
        """The static end, then the sequences of the loudest sources
        that may be reflected once more.
        """
        loudness = self.scene.log_amplitude
        louder = sorted(
            (i for i in self._reflectable(self.scene) if i), key=lambda i: -float(loudness[i])
        )
        return [self.scene.sequences[i] for i in (0, *louder[: PARENTS - 1])]

    def _antenna_images(self, parent: Reflections | None, points: Tensor) -> Tensor:
        """Images (E, m, 3) of the antennas when a parent, reflected once more,
        is at points (m, 3).
        """
        if parent is None:
            return points
        scene = self.scene.replace_sequences((parent,))
        return reflect(scene.images(self.rows), bisector(scene.sources, points))

    def _best_parent_and_plane(
        self, position: Tensor, posterior: GainPosterior
    ) -> tuple[Reflections, Tensor]:
        """Parent of a new source: its bisector with it, as a mirror,
        explains most of the residual.
        """
        scene, able = posterior.scene, self._reflectable(posterior.scene)
        planes = bisector(scene.sources[able], position)
        mirrored = reflect(scene.sources[None], planes[:, None])  # (parents, K, 3)
        flat = mirrored.flatten(0, 1)
        candidates = reflect(scene.images(self.rows)[..., None, :, :], planes[:, None]).flatten(
            -3, -2
        )
        sources = torch.cat([scene.sources, position[None]])
        new = torch.cdist(flat, sources).amin(1) > 0.5 * self.wavelength
        scores = score_candidates(posterior, candidates)[0].reshape(mirrored.shape[:2])
        order = torch.tensor([len(scene.sequences[i]) for i in able])
        gain = (scores * new.view_as(scores) - 6).clamp_min(0).sum(1) - 1.5 * order
        if self.rows.array is not None:  # parents differ in how they turn the antennas
            gain = gain + scores[torch.arange(len(able)), able]
        best = int(gain.argmax())
        return scene.sequences[able[best]], planes[best]

    def _try_paired_walls(self) -> None:
        """Find walls among all pairs of sources,
        reassign sources to them if the likelihood allows.
        """
        if len(self.scene.sequences) < 6:
            return
        self._try_walls(orders.find_walls(self.scene.sources))

    def _try_walls(self, walls: Tensor | None) -> None:
        """Reassign every source to these walls, if the likelihood allows."""
        if walls is None or out_of_steps():
            return
        before = self.scene
        self.scene = orders.reassign_to_walls(before, walls)
        self._refine(POLISHING_STEPS)
        for _ in range(2):
            if self._add_sequences(6):
                self._refine(ROUND_STEPS)
        saved = len(before.planes) - len(self.scene.planes)
        allowed = GainPosterior(self.rows, before).nll + 4 * saved
        if GainPosterior(self.rows, self.scene).nll >= allowed:
            self.scene = before
