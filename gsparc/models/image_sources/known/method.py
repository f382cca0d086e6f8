"""Image sources in known walls: no search,
the planes move by likelihood as far as the rows want.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsparc.data.walls import SceneWalls
from gsparc.models.image_sources.clutter.blocking import Clutter
from gsparc.models.image_sources.clutter.search import INITIAL_KERNEL
from gsparc.models.image_sources.ensemble import (
    Look,
    Member,
    left_out_nmse,
    occludes_antennas_alike,
)
from gsparc.models.image_sources.gp_likelihood import estimate_phases
from gsparc.models.image_sources.known import images
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.refine import learn_visibility, refine_scene
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene, direct_amplitude
from gsparc.models.image_sources.search import NOISE, Found, SearchSettings
from gsparc.physics.mirror_planes import Reflections, hesse_form
from gsparc.physics.waves import LIGHT
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)

LEAST_SIDE = 2.0  # wavelengths; smaller rectangles hide, but mirror nothing
MOVED_M, TURNED = 0.02, 0.01  # standard deviations of walls about those of the file [m], [rad]
LOG_AMPLITUDE_STD = 0.1  # about a factor per reflection
KERNEL, QUADRATURE = replace(INITIAL_KERNEL, constant=0.95), 0.1  # where walls say who sees what


class KnownWallsGP(ImageSourceGP):
    """See `ImageSourceGP`; sources are the images in walls of a file,
    without a search for their number.

    Args:
        walls: in the coordinates of the measurements.
        **rest: of `ImageSourceGP`; `clutter` says whether walls end and hide.

    Raises:
        ValueError: the data are not channels, or their phase means nothing.
    """

    name = "known_walls"

    def __init__(self, walls: SceneWalls, **settings: Any) -> None:
        super().__init__(**{**settings, "searches": 1})
        self.walls = walls
        self.kernel = KERNEL if self.settings.clutter else KernelVisibility()

    @property
    def stored_class(self) -> type[ImageSourceGP]:
        """See `Method`; what was found needs no walls to answer."""
        return ImageSourceGP

    def _run_searches(
        self,
        row_sets: list[Rows],
        settings: SearchSettings,
        effort: Effort,
        look: Look | None = None,
        start: Found | None = None,
    ) -> list[Member]:
        """The images in the walls, refined; no search,
        so that nothing is looked at or started from.
        """
        rows = row_sets[0]
        layout = self._initial_scene(rows, settings)

        def negative_log_prior(scene: SourceScene) -> Tensor:
            assert scene.phase is not None
            near = walls_prior_cost(
                layout.planes, layout.sequences, scene.planes, scene.log_amplitude
            )
            return near + prior.negative_log_density(scene.phase, layout.sequences)

        scene = estimate_phases(rows, layout, QUADRATURE, self.noise_floor)
        scene = learn_visibility(rows, scene, self.kernel)
        prior = ReflectionPhasePrior.from_scene(scene)
        scene = refine_scene(rows, scene, settings.final_steps, negative_log_prior)
        error = left_out_nmse(rows, scene)
        log.info(
            "known walls: %d sources over %d planes, error %.3f",
            len(scene.sequences),
            len(scene.planes),
            error,
        )
        return [Member(scene, error)]

    def _initial_scene(self, rows: Rows, settings: SearchSettings) -> SourceScene:
        """The static end and its images that some receiver sees, with amplitudes to start from."""
        transmitter = self._transmitter_in_frame()
        mirrors = images.Mirrors.from_walls(
            self.walls, self.fitted_site.origin + self.frame.middle.numpy()
        )
        if mirrors.left_out:
            most = images.MOST_PATCHES
            log.info(
                "the %d smallest of the walls are left out: more than %d", mirrors.left_out, most
            )
        indices = mirrors.large_planes(LEAST_SIDE * LIGHT / float(rows.frequency.mean()))
        order = settings.order
        if order > 1 and images.limit_mirrors(len(indices), order) < len(indices):
            few = images.limit_mirrors(len(indices), order)
            log.info(
                "images of %d reflections: in the %d largest of %d walls", order, few, len(indices)
            )
        hidden = settings.clutter and occludes_antennas_alike(rows)
        ends = transmitter, rows.position
        sequences = mirrors.visible_sequences(indices, *ends, order, settings.max_sources, hidden)
        obstacles = mirrors.obstacles_of(sequences, *ends) if hidden else Clutter.empty()
        direct = float(direct_amplitude(rows, transmitter))
        bare = SourceScene(
            transmitter,
            mirrors.planes,
            sequences,
            images.starting_log_amplitudes(sequences, direct),
            math.log(NOISE),
            self.kernel,
            noise_floor=self.noise_floor,
        )
        # without planes that neither mirror nor hide
        return replace(bare, clutter=obstacles).select_sources(
            [*range(len(sequences))], obstacles.plane
        )


@dataclass(frozen=True)
class ReflectionPhasePrior:
    """Prior of phases by reflection order: that of source k is von Mises about `expected`.

    Materials are nearly lossless or nearly opaque, so the phase shift of a reflection is about 0 or
    pi, the same for most walls of a room. This fixes the offset of a wall that few receivers see,
    which a free phase would leave ambiguous.

    Attributes:
        turn: phase shift of a reflection, 0 or pi [rad].
        concentration: kappa, by Best and Fisher's approximation from the mean resultant length (N.
            I. Fisher, "Statistical Analysis of Circular Data", 1993, section 4.5).
    """

    turn: float
    concentration: float

    @staticmethod
    def from_scene(scene: SourceScene) -> ReflectionPhasePrior:
        """Estimate from a scene's phases, weighted by power."""
        assert scene.phase is not None
        order, phase = torch.tensor([len(sequence) for sequence in scene.sequences]), scene.phase
        # Three phases lie near 0 or pi by chance.
        if len(order) < 4:
            return ReflectionPhasePrior(0.0, 0.0)
        power = scene.log_amplitude.mul(2).exp() * (order > 0)
        share, turn = max(
            (float((power * (phase - phase[0] - order * t).cos()).sum() / power.sum()), t)
            for t in (0.0, math.pi)
        )
        # At 1 the concentration is infinite.
        share = min(max(share, 0.0), 0.97)
        return ReflectionPhasePrior(turn, share * (2 - share**2) / (1 - share**2))

    def expected_phases(self, direct_phase: Tensor, sequences: tuple[Reflections, ...]) -> Tensor:
        """Return phases (K,) of sequences, given the transmitter's own."""
        return direct_phase + self.turn * torch.tensor(
            [float(len(sequence)) for sequence in sequences]
        )

    def negative_log_density(self, phase: Tensor, sequences: tuple[Reflections, ...]) -> Tensor:
        """Return the negative log prior of phases (K,), the transmitter's first."""
        return (
            self.concentration
            * (1 - (phase - self.expected_phases(phase[0], sequences)).cos()).sum()
        )


def walls_prior_cost(
    known: Tensor, sequences: tuple[Reflections, ...], planes: Tensor, log_amplitude: Tensor
) -> Tensor:
    """Return the negative log prior [nats]: planes (P, 4) about those known, amplitudes (K,)
    about a law.
    """
    (normal, offset), (given_normal, given_offset) = map(hesse_form, (planes, known))
    moved = (offset - given_offset).square().sum() / MOVED_M**2
    turned = (normal - given_normal).square().sum() / TURNED**2
    order = torch.tensor([float(len(sequence)) for sequence in sequences])
    law = torch.stack([torch.ones_like(order), order], 1)
    residual = log_amplitude - law @ (torch.linalg.pinv(law) @ log_amplitude)
    return (moved + turned + residual.square().sum() / LOG_AMPLITUDE_STD**2) / 2
