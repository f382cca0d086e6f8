"""The nearest training sample: the measure of how close the test set lies to the training set."""

from __future__ import annotations

from gsparc.models.baselines.idw import InverseDistance


class Nearest(InverseDistance):
    """Repeats the sample measured nearest to the query;
    its confidence falls off with the distance.
    """

    name = "nearest"
    baseline_order = 30

    def __init__(self) -> None:
        super().__init__(neighbours=1)
