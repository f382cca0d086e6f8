"""A term of a covariance, one object in one file: what it says of two sets of rows, and its parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, Generic, Self, TypeVar

import torch
from torch import Tensor

PLUGINS = "gsparc.terms"  # entry points of installed terms
KINDS: dict[str, type[Term[Any]]] = {}  # by the name that `stored` gives them
Rows = TypeVar("Rows")  # what terms know of measurements: places (n, D) of powers, groups of channels


def name_of(kind: type) -> str:
    """Return the name that a class is stored by: with its module where that is not ours."""
    ours = kind.__module__.startswith("gsparc.")
    return kind.__name__ if ours else f"{kind.__module__}.{kind.__qualname__}"


class Term(ABC, Generic[Rows]):
    """One additive part of what is known of values before any row; a prior is a sum of terms.

    Numbers of a term may be floats, or tensors with gradients where they are being learned.
    """

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        KINDS[name_of(cls)] = cls

    @abstractmethod
    def covariance(self, a: Rows, b: Rows) -> Tensor:
        """Return the covariance (n, m) of values at rows `a` (n) and `b` (m), real or complex."""

    @abstractmethod
    def variance(self, a: Rows) -> Tensor:
        """Return the variance (n,) of values at rows `a`, the diagonal of `covariance(a, a)`."""

    def parameters(self) -> Tensor:
        """Return what is learned of it (p,) float64, unbounded: logarithms of powers and lengths."""
        return torch.zeros(0, dtype=torch.float64)

    def bounds(self, scale: float) -> list[tuple[float, float]]:
        """Return bounds of each parameter, for rows whose distances are about `scale` [m]."""
        return []

    def at(self, parameters: Tensor) -> Self:
        """Return the term with other parameters (p,), through which gradients flow."""
        return self

    def state(self) -> dict[str, Any]:
        """Return tensors and numbers that `read` needs: its attributes, where these are such."""
        return dict(vars(self))

    @classmethod
    def read(cls, state: dict[str, Any]) -> Self:
        """Return the term whose `state()` this was."""
        return cls(**state)


class Columns(Term[Tensor]):
    """A term of places (n, D) [m] that is linear in weights of unit variance, times the prior's deviation."""

    @abstractmethod
    def columns(self, places: Tensor) -> Tensor:
        """Return what each weight adds (n, Q) at places (n, D) [m], differentiable in these."""

    def covariance(self, a: Tensor, b: Tensor) -> Tensor:
        """See `Term`."""
        return self.columns(a) @ self.columns(b).mT

    def variance(self, a: Tensor) -> Tensor:
        """See `Term`."""
        return self.columns(a).square().sum(-1)


def stored(term: Term[Any]) -> dict[str, Any]:
    """Return what `restored` reads: the name of the term's class, and its state."""
    return {"term": name_of(type(term)), "state": term.state()}


def restored(state: Mapping[str, Any]) -> Any:
    """Return the term that `stored` wrote.

    Raises:
        ValueError: nothing that was imported defines a term of this name.
    """
    name = str(state["term"])
    if name not in KINDS:
        for point in entry_points(group=PLUGINS):  # what is installed may be imported, a file's word may not
            if f"{point.module}.{point.attr}" == name:
                point.load()
    if name not in KINDS:
        raise ValueError(f"no term is called {name!r}: import the file that defines it before it is read")
    return KINDS[name].read(state["state"])
