"""`model=array`: spectra that a static array measures,
imaged from Gaussians by the array's response.
"""

from __future__ import annotations

from gsparc.field.gaussians import FieldSettings
from gsparc.field.initial import InitSettings
from gsparc.field.response import ResponseSettings
from gsparc.models.method import Method
from gsparc.models.splat.method import LearnedField


class ArrayField(LearnedField):
    """The complex field at a static array as a function of the transmitter's position.

    Args:
        field: number and places of the Gaussians.
        refit: learn from validation rows too (settings are chosen by cross-validation, not on
            them).
        name: as it appears in tables.
    """

    effects = "array"
    takes_effort = takes_weights = resumable = False  # it is solved in closed form

    def __init__(
        self,
        field: FieldSettings = FieldSettings(count=128),
        refit: bool = True,
        name: str = "array",
    ) -> None:
        super().__init__(
            field=field,
            response=ResponseSettings(array=True),
            init=InitSettings("vectors"),
            refit=refit,
            name=name,
            steps=0,
        )

    def settings_read(self) -> frozenset[str]:
        """See `Method.settings_read`."""
        return Method.settings_read(self)
