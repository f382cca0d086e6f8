"""Methods whose weights are known in closed form once Gaussians and covariances are:
conditioned on rows.

Searches and likelihoods find places, sizes and covariance parameters; the weights follow from the
training rows as in a Gaussian process (Rasmussen and Williams 2006, section 2.2), of which such a
method is one: its covariance is a sum of terms, one of them the Gaussians'.
Without Gaussians it is the plain process.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, NamedTuple, TypeVar, get_type_hints

import numpy as np
from torch import Tensor

from gsparc.base.instantiate import import_target, refuse_foreign
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.method import Method, import_path
from gsparc.training.context import FitContext

T = TypeVar("T")


@dataclass(frozen=True)
class LeftOutRows:
    """Training rows predicted from all others (Rasmussen and Williams 2006, eq. 5.12).

    Attributes:
        rows: (n,) of the measurements.
        mean: (n, ...) predictions, stored units.
        variance: (n,) expected squared error per entry.
        group: (n,) rows of one were left out together; None: each alone.
    """

    rows: np.ndarray
    mean: Tensor
    variance: Tensor
    group: np.ndarray | None = None

    def mean_at(self, rows: np.ndarray) -> Tensor:
        """Return predictions (m, ...) of some of the rows (m,)."""
        return self.mean[self._find(rows)]

    def variance_at(self, rows: np.ndarray) -> Tensor:
        """Return their variances (m,)."""
        return self.variance[self._find(rows)]

    def _find(self, rows: np.ndarray) -> np.ndarray:
        order = np.argsort(self.rows)
        return order[np.searchsorted(self.rows, rows, sorter=order)]


class Moments(NamedTuple):
    """Means of what is predicted, and variances (m,) after and before rows were learned from.

    Attributes:
        mean: any shape.
        variance: of the prediction.
        prior: the variance, or power, that is expected without any rows.
    """

    mean: Tensor
    variance: Tensor
    prior: Tensor


class ClosedForm(Method):
    """A method that can be conditioned on other rows, and predict rows from all others.

    Attributes:
        held: rows of groups, predicted by searches that left their group out; None where none did.
        forgets: whether `condition` on other rows leaves nothing of earlier ones but a few numbers.
    """

    held: LeftOutRows | None = None
    forgets = False
    no_gradient: str | None = None

    @property
    def count_gaussians(self) -> int:
        """Number of Gaussians; 0 where a process is all there is."""
        return self.count_components()

    @property
    def terms(self) -> tuple[str, ...]:
        """Terms that are computed, as in `model.effects`: `phase`, `power`,
        `residual` and so on.
        """
        return ("residual",)

    def condition(self, data: Measurements, rows: np.ndarray) -> None:
        """Set the weights from rows (n,); settings are chosen anew where that costs little."""
        self.fit(data, Fold.of_all(rows), FitContext())

    def left_out(self, rows: np.ndarray | None = None) -> LeftOutRows:
        """Return the rows it was conditioned on, each predicted from the others.

        Args:
            rows: (m,) that are asked for, of which it knows some; others may come with them. None:
                all.

        Raises:
            ValueError: not conditioned yet, or they are not kept.
        """
        raise ValueError(f"{self.name}: rows left out are not kept")

    def weighted_members(self) -> Iterator[tuple[float, ClosedForm]]:
        """Yield methods that are no mixtures, with their weights in the mean."""
        yield 1.0, self


def rows_left_out(members: Iterable[ClosedForm]) -> np.ndarray:
    """Return rows (n,) that each member predicted without them; none where one kept no such."""
    none = np.zeros(0, np.int64)
    rows = [none if member.held is None else member.held.rows for member in members]
    return functools.reduce(np.intersect1d, rows)


def method_state(method: Method) -> dict[str, Any]:
    """Return what `method_from_state` reads."""
    return {"target": import_path(method.stored_class), "state": method.state()}


def method_from_state(site: Site, state: dict[str, Any]) -> ClosedForm:
    """Return the method whose `method_state` state this was.

    Raises:
        ValueError: it names what is no such method of gsparc or a plugin.
    """
    # The class is named by a file: only gsparc's and plugins' are imported.
    refuse_foreign(state["target"])
    kind = import_target(state["target"])
    if not issubclass(kind, ClosedForm):
        raise ValueError(f"{state['target']} is not in closed form: train again")
    method = kind()
    method.restore(site, state["state"])
    return method


def to_containers(part: Any) -> Any:
    """Return a dict of a dataclass by its fields' names, lists of tuples, and all else as it is.

    >>> from gsparc.training.cost import Cost
    >>> to_containers(Cost({"search": 2.0}))
    {'stages': {'search': 2.0}, 'unused': {}}
    """
    if is_dataclass(part):
        return {each.name: to_containers(getattr(part, each.name)) for each in fields(part)}
    return [to_containers(each) for each in part] if isinstance(part, tuple) else part


def from_containers(kind: type[T], stored: dict[str, Any]) -> T:
    """Return the dataclass of this kind whose `to_containers` was stored; lists become tuples.

    >>> from gsparc.training.cost import Cost
    >>> from_containers(Cost, {"stages": {"search": 2.0}, "unused": {}}).seconds
    2.0

    Raises:
        TypeError: a field without a default is missing, or there is one that the kind does not
            have.
    """
    hints = get_type_hints(kind)
    return kind(**{name: _from_container(hints.get(name), value) for name, value in stored.items()})


def _from_container(hint: Any, value: Any) -> Any:
    if isinstance(hint, type) and is_dataclass(hint):
        return from_containers(hint, value)
    return (
        tuple(_from_container(None, each) for each in value) if isinstance(value, list) else value
    )
