"""Phases and delays of rows, taken off against the sources of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import Measurements
from gsparc.models.image_sources.rows import (
    measured_places,
    ranges_at,
)
from gsparc.models.image_sources.scene import SourceScene
from gsparc.physics.mirror_planes import image_rotations
from gsparc.physics.row_factors import UnknownFactor, align_factors
from gsparc.physics.waves import wave_over_band


def remove_offsets(
    data: Measurements,
    known: np.ndarray,
    scene: SourceScene,
    gains: Tensor,
    middle: Tensor,
    free: UnknownFactor,
) -> Measurements:
    """Return measurements whose known rows (n,) are without their offsets.

    Args:
        data: channels.
        known: rows.
        scene: whose sources have these gains.
        gains: (k, A) complex, constant over place.
        middle: (3,) of the frame of the sources [m].
        free: what of a row's factor is unknown.
    """
    frequency = data.site.tones()
    places, turned = (
        measured_places(data, known),
        image_rotations(scene.planes, scene.sequences),
    )
    away = ranges_at(places.flatten(0, 1), scene.sources + middle, turned)
    waves = wave_over_band(away, torch.from_numpy(frequency))
    # Antennas of known places share the gains; those of unknown ones each have their own.
    if gains.shape[1] == 1 or places.shape[1] > 1:
        gains = gains[:, :1]
    summed = torch.einsum("mkf,kr->mrf", waves, gains.to(waves.dtype))
    predicted = summed.reshape(len(known), -1, len(frequency)).numpy()
    measured = (
        data.target[known] if data.mask is None else np.where(data.mask, data.target, 0)[known]
    )
    target = data.target.copy()
    target[known] *= align_factors(measured, predicted, frequency, free)[:, None].astype(
        target.dtype
    )
    return replace(data, target=target)
