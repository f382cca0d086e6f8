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

from gsparc.coherent.phase import NEAR_M, ranges


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
    along_rx, across_rx = _about_edge(observers, points, axes)
    along_tx, across_tx = _about_edge(transmitter[None], points, axes)
    return ((along_rx - along_tx).square() + (across_rx + across_tx).square() + NEAR_M**2).sqrt()


def _about_edge(places: Tensor, points: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Cylinder coordinates (n, K) about each edge: along it, and distance from it."""
    offset = places.double()[:, None, :] - points.double()[None]
    along = (offset * axes).sum(-1)
    return along, torch.linalg.vector_norm(offset - along[..., None] * axes, dim=-1)
