"""Greedy furnishing: mirrors that end, boxes that hide, words over them; kept while the likelihood pays."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsparc.multipath import refine_phase
from gsparc.multipath.backprojection import pick_apart
from gsparc.multipath.clutter.blocking import SOFT, Clutter, shade, tangents, within
from gsparc.multipath.clutter.boxes import find_box, inside_out
from gsparc.multipath.clutter.finite_mirrors import SmallMirror, find_mirrors, find_patch, same_mirror, walls
from gsparc.multipath.clutter.refine import Accord, descend
from gsparc.multipath.clutter.residual import Explained, Residual
from gsparc.multipath.gp_likelihood import JITTER, Scene, steering
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene
from gsparc.multipath.rows import Rows
from gsparc.multipath.visibility_kernel import KernelVisibility
from gsparc.physics.mirror_planes import Word, all_words, images
from gsparc.physics.waves import LIGHT

log = logging.getLogger(__name__)

BOX, PATCH, MIRROR, WALL = 6, 4, 5, 3  # numbers of a box, a patch, a patch on a new plane, a new plane
FRESH, TURNING = KernelVisibility(0.9, 0.6, 1.5), 0.15  # of gains behind furniture, before they are learned
SURE = 1.0  # concentration from which on phases of new sources are foretold
SAME_FACE = 0.03  # [m]; a face that has moved less is not tried again
NEAR_WALL = 0.25  # [m]; faces that close to the end of the room are not tried as mirrors
SLIDE, SLIDE_STEP = 0.8, 0.08  # of a wavelength: how far, and how finely, a mirror is moved to fit its phases


@dataclass(frozen=True)
class Furnishing:
    """How often to look for furniture, and how hard.

    What a piece must gain to stay is half the logarithm of the rows' real numbers for each of its own:
    G. Schwarz, "Estimating the dimension of a model", Ann. Statist. 6 (1978).

    Attributes:
        epochs: rounds of everything, softer edges first.
        progress: nats; an epoch that gains fewer is the last.
        look: least nats promised before one is tried; `face`: before a mirror is, once in place.
        boxes, mirrors, words: most new ones in an epoch.
        beyond: how far outside the receivers' box furniture may reach [m].
        soft: width of edges in each epoch [m], the last for all that follow.
        steps: of the descent of everything but the furniture, at the end of each epoch.
    """

    epochs: int = 6
    progress: float = 10.0
    look: float = 12.0
    face: float = 8.0
    boxes: int = 4
    mirrors: int = 5
    words: int = 6
    beyond: float = 0.15
    soft: tuple[float, ...] = (0.08, 0.05, 0.03)
    steps: int = 8


def furnish(
    rows: Rows,
    phased: PhasedScene,
    generator: torch.Generator,
    settings: Furnishing = Furnishing(),
    deadline: float = math.inf,
    noise_floor: float = JITTER,
) -> PhasedScene:
    """The phased scene with furniture, or as it was when none pays.

    Args:
        rows: of one output, as many as a search looks at.
        phased: from the last descent of a search, its visibility a `KernelVisibility`.
        generator: of the candidates.
        settings: how hard to look.
        deadline: `time.monotonic()` after which nothing new is tried.
        noise_floor: known variance of the noise, in units of the rows' power.
    """
    # The law learned without furniture stands for it: forget it
    fresh = replace(
        phased, scene=replace(phased.scene, visibility=FRESH), turning=min(phased.turning, TURNING)
    )
    found = _Furnisher(rows, fresh, generator, settings, noise_floor).run(deadline)
    before, after = (PhasedPosterior(rows, each, noise_floor).factor.nll for each in (phased, found))
    return found if after < before - settings.progress else phased


class _Furnisher:
    def __init__(
        self,
        rows: Rows,
        phased: PhasedScene,
        generator: torch.Generator,
        settings: Furnishing,
        noise_floor: float,
    ) -> None:
        self.rows, self.generator, self.settings = rows, generator, settings
        self.noise_floor, self.wavelength = noise_floor, LIGHT / float(rows.frequency.mean())
        self.number = math.log(2 * len(rows)) / 2  # price of a number [nats]
        self.tried: list[SmallMirror] = []
        ends = torch.stack([rows.position.amin(0) - settings.beyond, rows.position.amax(0) + settings.beyond])
        self.room = ends.float()
        self._weigh(phased)

    # ---- where we stand ----
    def _weigh(self, phased: PhasedScene) -> None:
        """Factor the residual anew about a scene."""
        self.residual = Residual(self.rows, phased, self.noise_floor)
        self.accord = Accord.of(phased)
        self._stand(self.residual.phased)

    def _stand(self, phased: PhasedScene) -> None:
        """Go on from a scene, whose varying part is still that of the residual."""
        self.phased, self.paths = phased, phased.scene.unfolding.paths(self.rows.position)
        self.waves = phased.unshaded(self.rows)
        self.seen = shade(self.paths, phased.scene.clutter, phased.scene.planes)
        self.residual.waves = self.waves
        self.nll = self.residual.nll(self.seen, phased.scene.log_amplitude).item()

    @property
    def scene(self) -> Scene:
        return self.phased.scene

    def _explained(self) -> Explained:
        return self.residual.explained(self.seen, self.scene.log_amplitude)

    def _try(self, scene: Scene, least: float, phase: Tensor | None = None, exact: bool = False) -> bool:
        """Stay with a scene, a little descended, when it gains at least `least` nats.

        What varies and the noise are those of the scene last weighed; with `exact` they are the new scene's
        own, lest the old ones go on explaining what the new scene hides.
        """
        residual, before, nll = self.residual, self.phased, self.nll
        self._stand(replace(before, scene=scene, phase=before.phase if phase is None else phase))
        self._descend(6)
        if self.nll < nll - least:
            if exact:
                self._weigh(self.phased)
            if self.nll < nll - least:
                return True
        self.residual = residual
        self._stand(before)
        return False

    def _descend(self, steps: int, soft: float = SOFT) -> None:
        found = descend(self.residual, self.phased, self.paths, steps, soft, accord=self.accord)
        clutter = found.scene.clutter
        tidy = replace(clutter, boxes=inside_out(clutter.boxes, self.room))
        self._stand(replace(found, scene=replace(found.scene, clutter=tidy)))

    # ---- the loop ----
    def run(self, deadline: float) -> PhasedScene:
        s, start = self.settings, self.nll
        best = start, self.phased
        for epoch in range(s.epochs):
            before = self.nll
            for move in (self._mirrors, self._patches, self._boxes, self._words):
                if time.monotonic() < deadline:
                    move()
            self._loosen(s.soft[min(epoch, len(s.soft) - 1)])
            self._drop()
            self._weigh(self.phased)
            if time.monotonic() < deadline:
                self._look_again()
                self._descend(10)
                self._drop()
                self._weigh(self.phased)
                self._drop_words()
                self._weigh(
                    refine_phase.refine(self.rows, self.phased, s.steps, self.noise_floor, self._foretold)
                )
            best = min(best, (self.nll, self.phased), key=lambda b: b[0])
            log.debug(
                "epoch %d: %d boxes, %d patches, %d sources, nll %.1f (bare %.1f), noise %.3f, %s",
                epoch, len(self.scene.clutter.boxes), len(self.scene.clutter.patches), len(self.scene.words),
                self.nll, start, math.exp(self.scene.log_noise), self.scene.visibility,
            )  # fmt: skip
            if time.monotonic() > deadline or self.nll > before - s.progress:
                break
        return best[1]

    def _foretold(self, phase: Tensor) -> Tensor:
        """Cost of phases (K,) that are not what mirrors give here."""
        return self.accord.cost(phase, self.scene.words)

    def _loosen(self, soft: float) -> None:
        """Descend with softer edges, which feel what is farther away, then with those meant."""
        before, nll = self.phased, self.nll
        self._descend(16, soft)
        self._descend(10)
        if self.nll > nll:
            self._stand(before)
            self._descend(10)

    def _mirrors(self) -> None:
        s, scene = self.settings, self.scene
        found = find_mirrors(
            self.rows, self._explained(), scene.transmitter, scene.planes,
            walls(scene.planes, scene.words), self.room, 2 * s.mirrors,
        )  # fmt: skip
        found = [mirror for mirror in found if mirror.score > s.look]
        explained = self._explained()
        placed = [self._placed(mirror, explained) for mirror in [*found, *self._faces()]]
        hung: list[SmallMirror] = []
        for mirror in sorted(placed, key=lambda m: -m.score):
            if len(hung) == s.mirrors or mirror.score < s.face:
                break
            if not any(same_mirror(mirror, other, self.wavelength) for other in hung) and self._hang(mirror):
                hung.append(mirror)

    def _faces(self) -> list[SmallMirror]:
        """The faces of boxes, as far as they are not on floor or walls."""
        found = []
        for box in self.scene.clutter.boxes:
            for axis in range(3):
                for end in (0, 3):
                    offset = float(box[axis + end])
                    if min(offset - self.room[0, axis], self.room[1, axis] - offset) < NEAR_WALL:
                        continue
                    plane = torch.zeros(4, dtype=torch.float64)
                    plane[axis], plane[3] = 1.0, offset
                    corners = box.view(2, 3) @ tangents(plane).T
                    patch = torch.cat([corners.amin(0), corners.amax(0)])
                    face = SmallMirror(plane, patch, 0.0)
                    if not any(same_mirror(face, other, SAME_FACE) for other in self.tried):
                        found.append(face)
        self.tried += found
        return found

    def _placed(self, mirror: SmallMirror, explained: Explained) -> SmallMirror:
        """Moved along its normal to where its words have the phases that mirrors give here."""
        if self.accord.concentration < SURE:
            return mirror
        moves = torch.arange(-SLIDE, SLIDE + 1e-9, SLIDE_STEP, dtype=torch.float64) * self.wavelength
        planes = mirror.plane.repeat(len(moves), 1)
        planes[:, 3] += moves
        scene, known = self.scene, walls(self.scene.planes, self.scene.words)
        first = len(scene.planes)
        words = [word for i in range(len(moves)) for word in _over(first + i, known)]
        trial = replace(scene, planes=torch.cat([scene.planes, planes]), words=tuple(words))
        paths = trial.unfolding.paths(self.rows.position)
        inside = within(paths.end @ tangents(mirror.plane).T, mirror.patch[None])[0]
        inside = torch.where(paths.letter >= first, inside, 1.0).prod(-1)
        seen = shade(paths, scene.clutter, trial.planes) * inside * paths.valid
        turn = torch.polar(torch.ones(()), self.accord.expected(self.phased.phase[0], trial.words))
        scores = explained.score(steering(self.rows, trial.sources) * seen.T * turn)
        total = scores.view(len(moves), -1).sum(1)
        best = int(total.argmax())
        return SmallMirror(planes[best], mirror.patch, float(total[best]))

    def _with_mirror(self, mirror: SmallMirror) -> tuple[Scene, list[Word]]:
        scene = self.scene
        number, known = len(scene.planes), walls(scene.planes, scene.words)
        trial = replace(
            scene,
            planes=torch.cat([scene.planes, mirror.plane[None]]),
            clutter=scene.clutter.with_patch(mirror.patch, number),
        )
        return trial, _over(number, known)

    def _hang(self, mirror: SmallMirror) -> bool:
        """Try a small mirror with the words over it that pay."""
        trial, words = self._with_mirror(mirror)
        if self._wide(mirror):  # rather a wall
            endless = replace(trial, clutter=self.scene.clutter)
            if self._add(endless, words, 1.5, WALL * self.number, len(words)):
                return True
        return self._add(trial, words, 1.5, MIRROR * self.number, len(words))

    def _wide(self, mirror: SmallMirror) -> bool:
        """Whether a mirror reaches over most of the room."""
        ends = self.room @ tangents(mirror.plane).T
        return bool((mirror.patch[2:] - mirror.patch[:2] > 0.7 * (ends[1] - ends[0]).abs()).all())

    def _promises(
        self, scene: Scene, words: list[Word], explained: Explained
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Of words over a scene's planes: nats (W,), complex gains (W,), positions (W, 3)."""
        alone = replace(scene, words=tuple(words))
        paths = alone.unfolding.paths(self.rows.position)
        seen = shade(paths, scene.clutter, scene.planes) * paths.valid
        waves = steering(self.rows, alone.sources) * seen.T
        if self.accord.concentration < SURE:
            return *explained.score_waves(waves), alone.sources
        turn = torch.polar(torch.ones(()), self.accord.expected(self.phased.phase[0], alone.words))
        scores, gains = explained.score_positive(waves * turn)
        return scores, gains * turn, alone.sources

    def _add(self, scene: Scene, words: list[Word], promised: float, least: float, most: int) -> bool:
        """Try the words that promise enough, on a scene that may have more planes and patches."""
        # the words there are are hidden by new patches, too
        hidden = shade(self.paths, scene.clutter, scene.planes)
        explained = self.residual.explained(hidden, self.scene.log_amplitude)
        scores, gains, sources = self._promises(scene, words, explained)
        clear = torch.cdist(sources, self.scene.sources).amin(1) > 0.5 * self.wavelength
        chosen = pick_apart(sources, scores * clear, 0.5 * self.wavelength, most, promised)
        if not chosen:
            return False
        strong = gains[chosen].abs().clamp(0.02, float(self.scene.log_amplitude.exp().max()))
        phase = torch.cat([self.phased.phase, gains[chosen].angle()])
        return self._try(scene.with_words([words[i] for i in chosen], strong), least, phase)

    def _patches(self) -> None:
        """Ends of mirrors that have none."""
        scene, explained = self.scene, self._explained()
        shaded, found = self.waves * self.seen.T, []
        for number in set(range(len(scene.planes))) - set(scene.clutter.plane):
            patch, score = find_patch(
                explained, self.paths, scene.words, number, scene.planes[number], shaded, self.room,
                self.generator,
            )  # fmt: skip
            found.append((score, number, patch))
        for score, number, patch in sorted(found, key=lambda f: -f[0]):
            if score < self.settings.look:
                break
            mine = [k for k, word in enumerate(self.scene.words) if number in word]
            louder = self.scene.log_amplitude.clone()
            louder[mine] = louder[mine].clamp_min(float(louder.median()))
            clutter = self.scene.clutter.with_patch(patch, number)
            self._try(
                replace(self.scene, log_amplitude=louder, clutter=clutter), PATCH * self.number, exact=True
            )

    def _boxes(self) -> None:
        for _ in range(self.settings.boxes):
            box, score = find_box(
                self._explained(), self.paths, self.waves * self.seen.T, self.room, self.generator
            )
            if score < self.settings.look:
                break
            clutter = self.scene.clutter.with_box(box)
            if not self._try(replace(self.scene, clutter=clutter), BOX * self.number):
                break

    def _words(self) -> None:
        """More words over the planes there are."""
        scene, known = self.scene, set(self.scene.words)
        letters = list(range(len(scene.planes)))
        longer = [(*w, i) for w in scene.words if 0 < len(w) < 3 for i in letters if w[-1] != i]
        words = [w for w in dict.fromkeys(all_words(letters, 2) + longer) if w not in known]
        if not words:
            return
        places = images(scene.transmitter, scene.planes, words)
        scores, _ = self._explained().score_waves(steering(self.rows, places))
        best = scores.topk(min(60, len(words))).indices.tolist()
        self._add(scene, [words[i] for i in best], 6.0, self.number, self.settings.words)

    def _look_again(self) -> None:
        """Every box is looked for anew with the others in place."""
        for number in range(len(self.scene.clutter.boxes)):
            before, mine = self.phased, self.scene.clutter.boxes[number]
            nll = self.nll
            self._stand(self._with(self.scene.clutter.without_box(number)))
            near = mine + 0.1 * torch.randn(4, 6, generator=self.generator)
            box, _ = find_box(
                self._explained(), self.paths, self.waves * self.seen.T, self.room, self.generator,
                draws=400, parents=8, seeds=torch.cat([mine[None], near]),
            )  # fmt: skip
            self._stand(self._with(self.scene.clutter.with_box(box, number)))
            if self.nll > nll - 0.5:
                self._stand(before)

    def _with(self, clutter: Clutter) -> PhasedScene:
        return replace(self.phased, scene=replace(self.scene, clutter=clutter))

    def _drop(self) -> None:
        """Take out what no longer pays."""
        for kind, least in (("box", BOX * self.number), ("patch", PATCH * self.number)):
            number = 0
            while True:
                clutter = self.scene.clutter
                if number >= (len(clutter.boxes) if kind == "box" else len(clutter.patches)):
                    break
                rest = clutter.without_box(number) if kind == "box" else clutter.without_patch(number)
                before, nll = self.phased, self.nll
                self._stand(self._with(rest))
                if self.nll > nll + least:
                    self._stand(before)
                    number += 1

    def _drop_words(self) -> None:
        """Take out the sources whose constant part does not pay, if what varies of them does not, either."""
        gains = self.residual.gains_of_each(self.seen, self.scene.log_amplitude)
        kept = [k for k in range(len(gains)) if k == 0 or gains[k] > 0]
        dropped = len(gains) - len(kept)
        if dropped:
            residual, before, nll = self.residual, self.phased, self.nll
            self._weigh(replace(before, scene=self.scene.only(kept), phase=before.phase[kept]))
            if self.nll > nll + dropped * self.number:
                self.residual = residual
                self._stand(before)


def _over(number: int, known: list[int]) -> list[Word]:
    """Words of a plane: itself, after and before each wall."""
    return [(number,), *((wall, number) for wall in known), *((number, wall) for wall in known)]
