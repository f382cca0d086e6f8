"""The three kinds of source that a moving receiver can see of a static transmitter.

* `IMAGE`: a mirror image of the transmitter; the path is the straight line to it.
* `SCATTERER`: a small object; the leg transmitter-to-object is the same for every receiver and folds into the
  complex gain, what remains is again a spherical wave about a point.
* `EDGE`: a straight edge; the diffraction point slides along it so that both legs make the same angle with
  the edge (J. B. Keller, "Geometrical theory of diffraction", J. Opt. Soc. Am. 52 (1962)), hence the
  path is the straight line after unfolding both half planes about the edge.

The first two are one thing to a receiver: a fixed point. They differ when the transmitter moves.
"""

from __future__ import annotations

from enum import StrEnum

import torch
from torch import Tensor

from gsparc.multipath.rows import Rows
from gsparc.physics.waves import NEAR_M, ranges


class SourceKind(StrEnum):
    """What a virtual source stands for."""

    IMAGE = "image"
    SCATTERER = "scatterer"
    EDGE = "edge"


def path_length(
    kind: SourceKind, observers: Tensor, points: Tensor, transmitter: Tensor, axes: Tensor | None = None
) -> Tensor:
    """Length of each path whose phase an observer sees, up to a constant of the source.

    Args:
        kind: of all K sources.
        observers: (n, 3) float64 [m].
        points: (K, 3) float64 [m]: the image, the scatterer, or any point of the edge.
        transmitter: (3,) float64 [m]; used by `EDGE` only.
        axes: (K, 3) unit vectors along the edges; needed by `EDGE`.

    Returns:
        (n, K) float64 [m].

    Raises:
        ValueError: an edge without its direction.
    """
    if kind is not SourceKind.EDGE:
        return ranges(observers, points)
    if axes is None:
        raise ValueError("an edge needs its direction: pass axes (K, 3)")
    along_rx, across_rx = about_edge(observers, points, axes)
    along_tx, across_tx = about_edge(transmitter[None], points, axes)
    return ((along_rx - along_tx).square() + (across_rx + across_tx).square() + NEAR_M**2).sqrt()


def about_edge(places: Tensor, points: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Cylinder coordinates (n, K) [m] of places (n, 3) about each edge: along it, and distance from it."""
    offset = places.double()[:, None, :] - points.double()[None]
    along = (offset * axes).sum(-1)
    return along, (offset - along[..., None] * axes).square().sum(-1).add(NEAR_M**2).sqrt()


def kinds(points: Tensor, box: Tensor, margin: float = 0.05) -> list[SourceKind]:
    """What fixed points (K, 3) [m] stand for, the transmitter first.

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
