"""States of moving-array models that kept whole images, as they are kept now."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.array.moving.error_model import neighbourhoods
from gsparc.methods.gp import Kernel


def renewed(
    state: Mapping[str, Any], image: tuple[int, int], answer: Callable[[dict[str, Any]], Tensor]
) -> dict[str, Any]:
    """The state with pixels as the residual's basis; itself where it has a basis.

    Args:
        state: as stored.
        image: height and width [pixels].
        answer: images (n, H, W) at training places, of a field with a renewed state; their spread stands in
            for that of the training images, which is not stored.
    """
    if "basis" in state:
        return dict(state)
    errors, kernel = dict(state["doubt"]), Kernel(*map(float, state["rest"]))
    near, precision = neighbourhoods(kernel, errors.pop("places").numpy())
    errors = {name: value.float() if isinstance(value, Tensor) else value for name, value in errors.items()}
    reach = float(np.mean([float(trend["kernel"][0]) for trend in state["trends"]]))
    errors |= {"near": near, "precision": precision, "kernel": state["rest"], "reach": reach, "prior": 1.0}
    strongest = state["weights"].square().sum(0).argsort(descending=True)
    axes, weights = state["axes"][strongest].float(), state["weights"][:, strongest].float()
    residual = {"mean": state["mean"].float(), "axes": axes, "weights": weights}
    new = {name: state[name] for name in ("trends", "exponent", "positions", "shape", "seen")}
    new["basis"] = {"rows": torch.eye(image[0]), "columns": torch.eye(image[1])}
    new |= {"residual": {**residual, "kernel": state["rest"]}, "errors": errors}
    errors["prior"] = 2 * float(answer(new).var(0, correction=0).mean())
    return new
