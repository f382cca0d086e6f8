"""What a committee can spare: members, and whatever each of them can."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.committee import Committee, mean_of
from gsparc.data.schema import Measurements
from gsparc.method import Method, Prediction
from gsparc.ops import Pose
from gsparc.tradeoff import spare
from gsparc.tradeoff.points import Settings
from gsparc.tradeoff.view import View


def knobs(method: Committee) -> tuple[str, ...]:
    """`members`, and what any of them has."""
    inner = [knob for member in method.members.values() for knob in spare.knobs(member)]
    return ("members", *dict.fromkeys(inner))


def offered(method: Committee) -> dict[str, Sequence[Any]]:
    """Every subset of the members, all of them (`None`) first."""
    names = list(method.members)
    smaller = [list(c) for size in range(1, len(names)) for c in combinations(names, size)]
    return {"members": [None, *smaller]}


def measure(method: Committee, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
    """`<member>/<what it measures>`."""
    return {
        f"{name}/{key}": value
        for name, member in method.members.items()
        for key, value in spare.measure(member, data, rows).items()
    }


def reduced(method: Committee, settings: Settings, measured: dict[str, Tensor]) -> Method:
    """Some `members`, each with the settings it knows."""
    parts = []
    for name in settings.get("members") or method.members:
        member = method.members[name]
        own = {knob: value for knob, value in settings.items() if knob in spare.knobs(member)}
        known = {k.removeprefix(f"{name}/"): v for k, v in measured.items() if k.startswith(f"{name}/")}
        parts.append(spare.reduced(member, own, known))
    return parts[0] if len(parts) == 1 else Together(parts)


class Together(View):
    """The mean of several answers, nothing else."""

    def __init__(self, parts: list[Method]) -> None:
        super().__init__(parts[0])
        self.parts = parts

    @torch.no_grad()
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """See `Method.predict`."""
        return mean_of([part.predict(tx, rx) for part in self.parts])

    def size(self) -> int:
        """Of all parts."""
        return sum(part.size() for part in self.parts)
