"""Kinds of source between a static transmitter and a moving receiver.

* `IMAGE`: a mirror image of the transmitter; the path is the straight line to it.
* `SCATTERER`: a small object; the leg transmitter-to-object is the same for every receiver and folds into the
  complex gain, what remains is again a spherical wave about a point.

To a receiver both are fixed points; they differ when the transmitter moves.
"""

from __future__ import annotations

from enum import StrEnum

import torch
from torch import Tensor

from gsparc.models.image_sources.rows import Rows


class SourceKind(StrEnum):
    """Propagation mechanism of a source."""

    IMAGE = "image"
    SCATTERER = "scatterer"


def kinds(points: Tensor, box: Tensor, margin: float = 0.05) -> list[SourceKind]:
    """Kinds of fixed points (K, 3) [m], the transmitter first.

    A mirror image lies behind a mirror, outside of everything that the mirrors enclose; what stands inside
    the box (2, 3) [m] of receivers and transmitter, the transmitter itself apart, is a scatterer.

    Args:
        points: sources of one scene.
        box: lower and upper corner of all places measured.
        margin: by which the box is made smaller: images just behind a wall stay images [m].
    """
    inside = ((points > box[0] + margin) & (points < box[1] - margin)).all(1)
    apart = torch.linalg.vector_norm(points - points[0], dim=1) > 0.1
    return [SourceKind.SCATTERER if s else SourceKind.IMAGE for s in (inside & apart).tolist()]


def box_of(rows: Rows, transmitter: Tensor) -> Tensor:
    """Lower and upper corner (2, 3) [m] of all places measured and the transmitter (3,)."""
    places = torch.cat([rows.position, transmitter[None]])
    return torch.stack([places.amin(0), places.amax(0)])
