"""Paths of a solver's flat buffer."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsparc.simulate.effects import DIFFRACTION, EDGE
from gsparc.simulate.paths import TracedPaths


def collect_paths(solution: Any, receivers: int, ports: int) -> TracedPaths:
    """The solver's flat buffer, sorted; its padded public arrays would need receivers x longest
    list.
    """
    buffer = solution._paths_buffer
    owner = buffer.target_indices.numpy().astype(np.int64)
    if not len(owner):  # nothing is heard anywhere: the solver has made no gains either
        return TracedPaths.from_unsorted(
            receivers,
            owner,
            np.zeros((0, ports), np.complex64),
            np.zeros(0),
            np.zeros((0, 3), np.float32),
            *np.zeros((2, 0), np.uint8),
        )
    gain = np.stack([part[0].numpy() for part in buffer.a], axis=1).astype(np.complex64)
    delay = buffer.tau.numpy().astype(np.float64)
    kinds = buffer.interaction_types.numpy().astype(np.uint8).reshape(len(owner), -1)
    edge = np.zeros(len(owner), dtype=bool)
    if buffer.diffracting_wedges is not None:
        wedges = buffer.diffracting_wedges
        # A free edge has the same triangle on both sides.
        edge = wedges.prim0.numpy() == wedges.primn.numpy()
    kinds = np.where(edge[:, None] & (kinds == DIFFRACTION), EDGE, kinds).astype(np.uint8)
    mechanisms = (
        np.bitwise_or.reduce(kinds, axis=1) if kinds.shape[1] else np.zeros(len(owner), np.uint8)
    )
    order = (kinds > 0).sum(1).astype(np.uint8)
    direction = buffer.k_rx.numpy().T.astype(np.float32).reshape(len(owner), 3)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    sight = np.bincount(owner[order == 0], minlength=receivers)
    if len(sight) and sight.max() > 1:
        row = int(sight.argmax())
        raise RuntimeError(
            f"receiver {row} of a batch has {sight[row]} lines of sight, one at most is true"
        )
    return TracedPaths.from_unsorted(receivers, owner, gain, delay, direction, mechanisms, order)
