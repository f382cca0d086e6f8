"""Greedy search for clutter: finite mirrors, occluding boxes and reflections in them,
kept by likelihood.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from gsparc.models.image_sources.backprojection import select_separated
from gsparc.models.image_sources.clutter.blocking import BOX, PATCH, visible_share
from gsparc.models.image_sources.clutter.boxes import clip_boxes, find_occluding_box
from gsparc.models.image_sources.clutter.finite_mirrors import (
    SmallMirror,
    find_patch,
    find_small_mirrors,
)
from gsparc.models.image_sources.clutter.refine import refine_with_clutter
from gsparc.models.image_sources.clutter.residual import ClutterLikelihood, UnexplainedRows
from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.refine import refine_scene
from gsparc.models.image_sources.reflection_orders import ORDER
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene
from gsparc.physics.mirror_planes import Reflections
from gsparc.physics.waves import LIGHT
from gsparc.processes.worker import Cancelled, cancel_when, out_of_steps, raise_if_cancelled

log = logging.getLogger(__name__)

MIRROR, SEQUENCE = PATCH + 1, 1  # parameters: of a patch and its plane's offset, of an amplitude
INITIAL_KERNEL, QUADRATURE = KernelVisibility(0.9, 0.6, 1.5), 0.15  # in the presence of clutter
EPOCHS = 6  # rounds of everything
STEPS = 8  # of the descent on everything but clutter, at the end of each epoch
PROGRESS = 10.0  # [nats]; an epoch that gains fewer is the last
MIN_GAIN = 12.0  # least [nats] of a candidate, predicted
BOXES, MIRRORS, SEQUENCES = 4, 5, 6  # most new ones in an epoch
BEYOND = 0.15  # [m] margin of clutter around the receivers' box


def add_clutter(rows: Rows, scene: SourceScene, generator: torch.Generator) -> SourceScene:
    """Return the scene with clutter, or unchanged when the likelihood gains too little.

    A piece must gain half the logarithm of the number of real observations per parameter:
    G. Schwarz, "Estimating the dimension of a model", Ann. Statist. 6 (1978). When it is
    `out_of_steps`, what was found so far is the result.

    Args:
        rows: of one output, as many as in a search.
        scene: from the final refinement of a search.
        generator: of the candidates.
    """
    # The kernel learned without clutter explains it: reset
    fresh = replace(scene, visibility=INITIAL_KERNEL, quadrature=min(scene.quadrature, QUADRATURE))
    trial = _ClutterSearcher(rows, fresh, generator).run()
    before, after = (GainPosterior(rows, each).nll for each in (scene, trial))
    return trial if after < before - PROGRESS else scene


class _ClutterSearcher:
    def __init__(self, rows: Rows, scene: SourceScene, generator: torch.Generator) -> None:
        self.rows, self.generator = rows, generator
        self.wavelength = LIGHT / float(rows.frequency.mean())
        self.parameter_cost = math.log(2 * len(rows)) / 2  # cost of a parameter [nats]
        ends = torch.stack([rows.position.amin(0) - BEYOND, rows.position.amax(0) + BEYOND])
        self.room = ends.float()
        self._refactor(scene)

    # ---- state ----
    def _refactor(self, scene: SourceScene) -> None:
        """Factor the residual's covariance at a scene."""
        self.residual = ClutterLikelihood(self.rows, scene)
        self._set_scene(self.residual.scene)

    def _set_scene(self, scene: SourceScene) -> None:
        """Set the scene, with the varying part still that of the residual."""
        self.scene, self.paths = scene, scene.unfolding.paths(self.rows.position)
        self.waves = scene.unobstructed_waves(self.rows)
        self.visible = visible_share(self.paths, scene.clutter, scene.planes)
        self.residual.waves = self.waves
        self.nll = self.residual.nll(self.visible, scene.log_amplitude).item()

    def _unexplained_rows(self) -> UnexplainedRows:
        scorer = self.residual.make_scorer(self.visible, self.scene.log_amplitude)
        waves = self.waves * self.visible.T
        return UnexplainedRows(
            self.rows, self.scene, scorer, self.paths, waves, self.room, self.generator
        )

    def _try_scene(self, scene: SourceScene, parameters: int, refactor: bool = False) -> bool:
        """Accept a scene after a few steps of descent,
        when it gains the cost of so many parameters.

        Varying part and noise are those last factored; with `refactor` they are the new scene's,
        since the old ones would explain what the new scene occludes.
        """
        nll, least = self.nll, parameters * self.parameter_cost

        def descend_from_scene() -> None:
            self._set_scene(scene)
            self._descend(6)
            if refactor and self.nll < nll - least:
                self._refactor(self.scene)

        return self._keep_if_better(descend_from_scene, least)

    def _keep_if_better(self, change: Callable[[], None], min_gain: float) -> bool:
        """Change something, and undo it where that gains fewer than `min_gain` nats."""
        residual, before, nll = self.residual, self.scene, self.nll
        change()
        if self.nll < nll - min_gain:
            return True
        self.residual = residual
        self._set_scene(before)
        return False

    def _descend(self, steps: int) -> None:
        scene = refine_with_clutter(self.residual, self.scene, self.paths, steps)
        boxes = clip_boxes(scene.clutter.boxes, self.room)
        self._set_scene(replace(scene, clutter=replace(scene.clutter, boxes=boxes)))

    # ---- the loop ----
    def run(self) -> SourceScene:
        start = self.nll
        best = self.whole = start, self.scene
        try:
            with cancel_when(out_of_steps):  # within a step, too
                for epoch in range(EPOCHS):
                    before = self.nll
                    self._run_round()
                    best = min(best, self.whole, key=lambda b: b[0])
                    log.debug(
                        "epoch %d: %d boxes, %d patches, %d sources, nll %.1f (bare %.1f), noise "
                        "%.3f, %s",
                        epoch,
                        len(self.scene.clutter.boxes),
                        len(self.scene.clutter.patches),
                        len(self.scene.sequences),
                        self.nll,
                        start,
                        math.exp(self.scene.log_noise),
                        self.scene.visibility,
                    )
                    if self.nll > before - PROGRESS:
                        break
        except Cancelled:
            raise_if_cancelled()  # by the clock alone: what was found so far is the result
            best = min(best, self.whole, key=lambda b: b[0])
        return best[1]

    def _run_round(self) -> None:
        """One round of everything; what each step leaves is `whole`."""
        for step in (
            self._try_mirrors,
            self._try_patches,
            self._try_boxes,
            self._try_sequences,
            self._prune,
        ):
            step()
            self.whole = self.nll, self.scene

    def _prune(self) -> None:
        """Move what there is, drop what the likelihood no longer supports, and factor anew."""
        self._descend(10)
        self._drop_clutter()
        self._refactor(self.scene)
        self._refactor(refine_scene(self.rows, self.scene, STEPS))

    def _try_mirrors(self) -> None:
        """Try small mirrors, each with its best sequences."""
        added: list[SmallMirror] = []
        for mirror in find_small_mirrors(self._unexplained_rows(), 2 * MIRRORS):
            if len(added) == MIRRORS or mirror.score < MIN_GAIN:
                break
            double = any(mirror.overlaps(other, self.wavelength) for other in added)
            if not double and self._add_mirror(mirror):
                added.append(mirror)

    def _add_mirror(self, mirror: SmallMirror) -> bool:
        scene, number = self.scene, len(self.scene.planes)
        # Itself, after and before each wall.
        sequences: list[Reflections] = [(number,)]
        sequences += [(wall, number) for wall in scene.walls] + [
            (number, wall) for wall in scene.walls
        ]
        clutter = scene.clutter.add_patch(mirror.patch, number)
        trial = replace(
            scene, planes=torch.cat([scene.planes, mirror.plane[None]]), clutter=clutter
        )
        return self._add_sequences(trial, sequences, 1.5, MIRROR, len(sequences))

    def _add_sequences(
        self,
        scene: SourceScene,
        sequences: list[Reflections],
        min_score: float,
        parameters: int,
        limit: int,
    ) -> bool:
        """Try sequences of at least `min_score` nats,
        on a scene of so many more parameters of planes.
        """
        # new patches occlude present sequences, too
        hidden = visible_share(self.paths, scene.clutter, scene.planes)
        scorer = self.residual.make_scorer(hidden, self.scene.log_amplitude)
        new = scene.replace_sequences(sequences)
        paths = new.unfolding.paths(self.rows.position)
        seen = visible_share(paths, scene.clutter, scene.planes) * paths.valid
        scores, gains = scorer.gains_and_amplitudes(new.unobstructed_waves(self.rows) * seen.T)
        chosen = select_separated(
            new.sources, scores, 0.5 * self.wavelength, limit, min_score, self.scene.sources
        )
        if not chosen:
            return False
        strong = gains[chosen].abs().clamp(0.02, float(self.scene.log_amplitude.exp().max()))
        more = [sequences[i] for i in chosen]
        return self._try_scene(scene.add_sequences(more, strong, gains[chosen].angle()), parameters)

    def _try_patches(self) -> None:
        """Try patches on infinite mirrors."""
        residual_rows, patches = self._unexplained_rows(), []
        for number in set(range(len(self.scene.planes))) - set(self.scene.clutter.plane):
            patch, score = find_patch(residual_rows, number)
            patches.append((score, number, patch))
        for score, number, patch in sorted(patches, key=lambda f: -f[0]):
            if score < MIN_GAIN:
                break
            numbers = [k for k, sequence in enumerate(self.scene.sequences) if number in sequence]
            louder = self.scene.log_amplitude.clone()
            louder[numbers] = louder[numbers].clamp_min(float(louder.median()))
            clutter = self.scene.clutter.add_patch(patch, number)
            trial = replace(self.scene, log_amplitude=louder, clutter=clutter)
            self._try_scene(trial, PATCH, refactor=True)

    def _try_boxes(self) -> None:
        for _ in range(BOXES):
            box, score = find_occluding_box(self._unexplained_rows())
            if score < MIN_GAIN:
                break
            if not self._try_scene(
                replace(self.scene, clutter=self.scene.clutter.add_box(box)), BOX
            ):
                break

    def _try_sequences(self) -> None:
        """Try more sequences over the present planes."""
        scene, sequences = self.scene, self.scene.longer_sequences(ORDER)
        if not sequences:
            return
        scores, _ = self._unexplained_rows().scorer.gains_and_amplitudes(
            scene.replace_sequences(sequences).unobstructed_waves(self.rows)
        )
        best = scores.topk(min(60, len(sequences))).indices.tolist()
        self._add_sequences(scene, [sequences[i] for i in best], 6.0, SEQUENCE, SEQUENCES)

    def _drop_clutter(self) -> None:
        """Remove clutter that the likelihood no longer supports."""
        number = 0
        while number < len(clutter := self.scene.clutter):
            parameters = BOX if number < len(clutter.boxes) else PATCH
            less = replace(self.scene, clutter=clutter.remove_piece(number))
            cost = parameters * self.parameter_cost
            number += not self._keep_if_better(partial(self._set_scene, less), -cost)
