"""Fields whose weights are known in closed form once Gaussians and covariances are: conditioned on rows.

Searches and likelihoods find places, sizes and covariance parameters; the weights follow from the training
rows as in a Gaussian process (Rasmussen and Williams 2006, section 2.2), of which such a field is one: its
covariance is a sum of terms, one of them the Gaussians'. Without Gaussians it is the plain process.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import SiteObjects
from gsparc.models.method import Prediction


@dataclass(frozen=True)
class LeftOutRows:
    """Training rows predicted from all others (Rasmussen and Williams 2006, eq. 5.12).

    Attributes:
        rows: (n,) of the measurements.
        mean: (n, ...) predictions, stored units.
        variance: (n,) expected squared error per entry.
    """

    rows: np.ndarray
    mean: Tensor
    variance: Tensor


class ConditionalField(ABC):
    """Gaussians and covariances as an initialiser found them; `condition` sets the weights.

    Attributes:
        kind: the initialiser that makes it, see `gsparc.models.fields.INITIALISERS`; none of composed ones.
        site: what the dataset declares; set where the field is made.
        held: rows of groups, predicted by searches that left their group out; None where none did.
    """

    kind: ClassVar[str] = ""
    site: Site
    held: LeftOutRows | None = None

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of Gaussians; 0 where the residual process is all there is."""

    @property
    def forgets(self) -> bool:
        """Whether `condition` on other rows leaves nothing of earlier ones but a few numbers."""
        return False

    @property
    @abstractmethod
    def terms(self) -> tuple[str, ...]:
        """Terms that are computed, as in `model.effects`: `phase`, `power`, `residual` and so on."""

    @abstractmethod
    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Set the weights from rows (n,)."""

    @abstractmethod
    def __call__(self, query: Query) -> Prediction:
        """Predict, with `variance` and `unknown`; see `Method.predict`.

        Followed by autograd, and of double precision, where positions are float64.
        """

    def parts(self) -> Iterator[tuple[float, ConditionalField]]:
        """Yield fields that are no mixtures, with their weights in the mean."""
        yield 1.0, self

    def objects(self) -> SiteObjects:
        """What it found to stand in the site."""
        return SiteObjects.of()

    @abstractmethod
    def left_out(self) -> LeftOutRows:
        """The rows it was conditioned on, each predicted from the others."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Tensors, numbers and strings from which it is made again."""
