"""`model=array`, spectra of a static array: the Gaussian field through the array under a name of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsparc.array.cross_validation import compared
from gsparc.array.phase_retrieval import recover
from gsparc.data.schema import Measurements, Site
from gsparc.field.gaussians import FieldSettings
from gsparc.field.initial import InitSettings
from gsparc.field.response import ResponseSettings
from gsparc.methods.method import PredictsVariance
from gsparc.training.splatting import LearnedField

ARRAY_SHARE = 0.75  # of the probed images that the declared array must be able to have measured


class ArrayField(LearnedField, PredictsVariance):
    """The complex field at a static array as a function of the transmitter's position.

    Args:
        field: number and places of the Gaussians.
        refit: learn from validation rows too (settings are chosen by cross-validation, not on them).
        name: as it appears in tables.
    """

    effects = "array"
    takes_budget = False
    resumable = False

    def __init__(
        self, field: FieldSettings = FieldSettings(), refit: bool = True, name: str = "array"
    ) -> None:
        super().__init__(
            field=field,
            response=ResponseSettings(array=True),
            init=InitSettings("vectors"),
            refit=refit,
            name=name,
            steps=0,
        )

    def explains(self, data: Measurements, rows: np.ndarray, seed: int) -> tuple[bool, str]:
        """See `Explains`: whether vectors of one number per element make the images of rows (n,)."""
        found = recover(data.site, data.target[rows], data.moving[rows], seed=seed)
        share = 1 - float(found.suspect.mean())
        assert data.site.array is not None
        elements = len(data.site.array)
        reason = f"{share:.0%} of {len(rows)} probed images are explained by {elements} complex numbers each"
        return share >= ARRAY_SHARE, reason

    def compared_with_gp(self) -> tuple[float, float] | None:
        """See `ComparesWithGP`."""
        return None if self._left_out is None else compared(self._left_out)

    def trainer_options(self) -> bool:
        """See `TrainsByGradient`: it is solved in closed form."""
        return False

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`.

        Raises:
            ValueError: the state is of an earlier version's wave packets.
        """
        if "packets" in state:
            raise ValueError("it is made of wave packets, as earlier versions were; train it again")
        super().restore(site, state)
