"""Complex factors of antennas: cables and converters give each of an array a gain
and a phase of its own.

They are the same at all places, so that aligned rows `u_e y` follow the process of calibrated
antennas; the factors of largest likelihood are found as those of runs are (`best_run_factors`),
first against the direct path alone, then against all sources found. They are used where they gain
more than their number costs: G. Schwarz, "Estimating the dimension of a model", Ann. Statist.
6 (1978).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsparc.models.image_sources.gp_likelihood import GainPosterior
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import SourceScene
from gsparc.models.run_factors import best_run_factors, factor_matrix

UNEXPLAINED = 0.5  # share of the power that is not the direct path's, before any search


def direct_path_scene(rows: Rows, static: Tensor, noise_floor: float) -> SourceScene:
    """Return the static end (3,) [m] alone, with its share of the power of unit rows."""
    scene = SourceScene.from_static_end(static, torch.zeros(1), math.log(UNEXPLAINED))
    power = (1 - UNEXPLAINED) / scene.waves(rows).abs().square().mean()
    return replace(scene, log_amplitude=power.sqrt().log().reshape(1), noise_floor=noise_floor)


def find_element_factors(rows: Rows, scene: SourceScene) -> Tensor | None:
    """Return factors (E,) complex64 for channels of each antenna, the first 1; None:
    nothing gained.

    Args:
        rows: of a static array of E antennas, one output; those without a row are multiplied by 1.
        scene: sources known so far.
    """
    assert rows.array is not None and rows.element is not None
    scene = replace(scene, phase=None)
    conditioned = GainPosterior(rows, scene).conditioned
    elements, run = np.unique(rows.element.numpy(), return_inverse=True)
    inverse = conditioned.factor.inverse.to(torch.complex128).numpy()
    quadratic = factor_matrix(inverse, rows.target.to(torch.complex128).numpy(), run)
    estimate = best_run_factors(quadratic, rows.target.shape[1] * np.bincount(run))
    each = np.ones(len(rows.array), np.complex128)
    each[elements] = estimate / estimate[0]
    factors = torch.from_numpy(each.astype(np.complex64))
    target = rows.target * factors[rows.element, None]
    scale = target.abs().square().mean().sqrt()  # sources absorb a common factor
    nll = GainPosterior(replace(rows, target=target / scale), scene).nll
    jacobian = 2 * float((factors.abs().log()[rows.element] - scale.log()).double().sum())
    gain = conditioned.nll - (nll - jacobian)
    cost = (len(elements) - 1) * math.log(len(rows))
    return factors if gain > cost else None
