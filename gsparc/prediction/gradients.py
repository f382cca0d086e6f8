"""Predictions that autograd follows, in reverse mode, by the position of what moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import End
from gsparc.models.method import Method, Prediction
from gsparc.models.predicting import suitable_threads
from gsparc.ops import Pose
from gsparc.ops.transforms import needs_reference
from gsparc.prediction.query import PlacedQuery, Queries


class FollowedPrediction(NamedTuple):
    """Moments in stored units, in float64, the precision of the positions, and what was asked."""

    moments: Prediction
    dtype: torch.dtype
    placed: PlacedQuery


def predict_with_gradients(
    method: Method, queries: Queries, tx: Any, rx: Any
) -> FollowedPrediction:
    """Return a prediction with gradients by position.

    Args:
        method: that answers.
        queries: of its site.
        tx, rx: as a `Predictor` is asked, what moves as tensors.

    Raises:
        ValueError: the method has no gradients, or the positions are no tensors or those of a
            transform.
    """
    problem, site = method.gradient_problem(), queries.site
    if problem is not None:
        raise ValueError(f"grad=True: {method.name} has no gradients by position: {problem}")
    ends: dict[End, Any] = {"tx": tx, "rx": rx}
    fixed = []
    if isinstance(rx, Pose):
        # Gradients are by the position of a pose; its rotation must not ask for one.
        ends["rx"], fixed = rx.position, [rx.rotation]
    fixed += [ends.pop(end) for end in {*ends} - {*site.moving_ends}]
    for end, value in ends.items():
        if value is not None and not isinstance(value, Tensor):
            raise ValueError(
                f"grad=True: {end}= must be a torch tensor, got {type(value).__name__}"
            )
    if needs_reference(*ends.values(), *fixed):
        raise ValueError(
            "grad=True: torch.func, torch.vmap and forward mode are not followed; "
            "take torch.autograd.grad of all positions at once, (B, 3)"
        )
    if any(isinstance(value, Tensor) and value.requires_grad for value in fixed):
        raise ValueError(f"grad=True: gradients are by the position of {' and '.join(ends)} alone")
    placed = queries.query(tx, rx, torch.float64)
    query = placed.query
    origin = torch.from_numpy(np.asarray(site.origin, np.float64))
    # The origin goes in float64: in UTM coordinates float32 has no centimetres.
    local = {end: placed.at_stations(value.cpu().double() - origin) for end, value in ends.items()}
    with suitable_threads(method, len(query)):
        moments = method.predict(query.with_ends(local))
    dtype = torch.float32
    for value in ends.values():
        # Computed in float64, answered as precisely as the positions were given.
        dtype = torch.promote_types(dtype, value.dtype)
    return FollowedPrediction(moments, dtype, placed)
