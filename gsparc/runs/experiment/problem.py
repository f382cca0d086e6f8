"""What methods are compared on: one dataset under one draw of a split."""

from __future__ import annotations

from dataclasses import dataclass

from gsparc.data.schema import Measurements, Scored
from gsparc.data.splits import Split
from gsparc.models.powers.together.network import find_sectors
from gsparc.simulate.scenes.build import has_known_scene


@dataclass(frozen=True)
class Problem:
    """One dataset under one draw of a split.

    Attributes:
        dataset, split: names.
        chosen: overrides of train.yaml for dataset and split, but for the draw.
        data: measurements.
        folds: which rows learn and which test.
        content: hash of the measurements, see `measurements_hash`.
        draw: number of the split's draw; None where it is not drawn again.
    """

    dataset: str
    split: str
    chosen: tuple[str, ...]
    data: Measurements
    folds: Split
    content: str = ""
    draw: int | None = None

    @property
    def name(self) -> str:
        """dataset/split."""
        return f"{self.dataset}/{self.split}"

    @property
    def kind(self) -> Scored:
        """Of the measurements."""
        return self.data.site.scored

    @property
    def stations(self) -> bool:
        """Whether there are several, of which rows of each are learned from."""
        return self.data.site.stations is not None and self.folds.name != "stations"

    @property
    def network(self) -> bool:
        """Whether stations are sectors of a network, which `gsparc` learns together in any case."""
        return self.data.site.target.is_level and find_sectors(self.data) is not None

    @property
    def scene(self) -> bool:
        """Whether the measurements name a scene that a ray tracer loads."""
        return has_known_scene(self.data.provenance)
