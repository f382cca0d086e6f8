"""`model=splat`: Gaussians trained by rendering, with no process beside them."""

from __future__ import annotations

from typing import Any

from gsparc.models.splat.method import LearnedField


class Splat(LearnedField):
    """The rendered field alone: what ablations of its options compare.

    Args:
        name: as it appears in tables.
        **field: see `LearnedField`.
    """

    effects = "image"

    def __init__(self, name: str = "splat", **field: Any) -> None:
        super().__init__(name=name, **field)
