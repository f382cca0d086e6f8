"""Known walls as Gaussians that straight paths lose power in, for the field of powers.

A loss per wall crossed is the multi-wall model (COST Action 231, "Digital mobile radio towards future
generation systems", final report, 1999, section 4.7.2); parts of a wall may differ.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from gsparc.data.walls import SceneWalls
from gsparc.multipath.clutter.blocking import tangents
from gsparc.multipath.known.mirrors import Mirrors
from gsparc.multipath.powers.blockers import Blockers

WALL_DB = 8.0  # standard deviation of what a wall takes: COST 231 has 3.4 dB for light, 6.9 dB for heavy ones
PART_DB = 3.0  # of what its parts take more or less
THICK_M = 0.1  # [m], standard deviation across a wall
# Of a path along a wall, which power goes around: as much as at 75 degrees from its normal. Without a bound
# a place beside a wall of 28 m was 126 dB too dark.
OBLIQUE = 4.0
LEVEL, UPRIGHT = 0.995, 0.1  # of the normal's upward part: floors, walls; what leans is left out
PANELS = (1, 2, 4)  # that a wall is cut into along its length, each more than the ones before


def panels(walls: SceneWalls, origin: np.ndarray) -> tuple[Blockers, int]:
    """Gaussians of walls and their parts, of floors and of boxes, and how many leaning walls are left out.

    Their strengths are logarithms of decibels, see `Blockers.relative_to`.

    Args:
        walls: of a file.
        origin: (3,) float64 [m], of the frame in the file's coordinates.
    """
    mirrors = Mirrors.of(walls, origin)
    means: list[np.ndarray] = []
    scales: list[list[float]] = []
    turns: list[float] = []
    levels: list[float] = []
    leaning = 0
    for patch, number in zip(mirrors.clutter.patches.double().numpy(), mirrors.clutter.plane, strict=True):
        plane = mirrors.planes[number]
        normal, along = plane[:3].numpy(), tangents(plane).double().numpy()
        if UPRIGHT < abs(normal[2]) < LEVEL:
            leaning += 1
            continue
        level = abs(normal[2]) >= LEVEL
        half = np.maximum(patch[2:] - patch[:2], 2 * THICK_M) / 2
        for count in (1,) if level else PANELS:
            for part in range(count):
                share = (2 * part + 1) / count - 1
                at = (patch[:2] + patch[2:]) / 2 + [share * half[0], 0.0]
                means.append(at @ along + plane[3].item() * normal)
                long, high = half[0] / count, half[1]
                scales.append([long, high, THICK_M] if level else [THICK_M, long, high])
                turns.append(0.0 if level else math.atan2(normal[1], normal[0]))
                levels.append(WALL_DB if count == 1 else PART_DB)
    for box in mirrors.clutter.boxes.double().numpy():
        means.append((box[:3] + box[3:]) / 2)
        scales.append([*np.maximum((box[3:] - box[:3]) / 2, THICK_M)])
        turns.append(0.0)
        levels.append(WALL_DB)
    found = Blockers(
        torch.from_numpy(np.array(means).reshape(-1, 3)),
        torch.from_numpy(np.array(scales).reshape(-1, 3)).log(),
        torch.tensor(turns, dtype=torch.float64),
        torch.tensor(levels, dtype=torch.float64).log(),
        most=torch.tensor(OBLIQUE, dtype=torch.float64),
    )
    return found, leaning
