"""Sources that a moving array sees as the Gaussians of a field: places are searched, powers in closed form.

A Gaussian here is a source at the place where bearings from many receivers cross. Powers, their trends over
the receiver's place and the residual process follow from the rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.models.conditional import LeftOutRows
from gsparc.models.method_field import MethodField
from gsparc.models.moving_array.method import MovingArrayField


class BearingField(MethodField):
    """The sources of one or several searches.

    Args:
        method: fitted, or restored.
        rows: (n,) of the measurements it was fitted on, in its order; none where it was restored.
    """

    kind = "bearings"
    makes = MovingArrayField

    def __init__(self, method: MovingArrayField, rows: Sequence[int] | np.ndarray = ()) -> None:
        super().__init__(method)
        self.rows = np.asarray(rows, np.int64)

    @property
    def terms(self) -> tuple[str, ...]:
        """Sources seen through the array, and a residual where one is fitted."""
        return ("moving_array", "residual") if len(self.method.residual.axes) else ("moving_array",)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """See `ConditionalField`; sources and kernels stay those of the search."""
        self.rows = self.method.condition(data, rows)

    def left_out(self) -> LeftOutRows:
        """See `ConditionalField`."""
        self._need_rows()
        return self.method.left_out(self.rows)

    def _need_rows(self) -> None:
        """`ValueError` where a restored field was not conditioned again: left-out rows are not stored."""
        if not len(self.rows):
            raise ValueError(
                "bearings: condition the field on rows first, a stored one has none to leave out"
            )
