"""What is known of channels before any row: a sum of terms, relative to each group's scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from gsparc.models.channels.columns import Group, SlotPlaces
from gsparc.models.channels.terms import KINDS, Noise
from gsparc.models.channels.terms.term import ChannelTerm, Frame
from gsparc.processes.stored import Stored

T = TypeVar("T", bound=ChannelTerm)


@dataclass(frozen=True)
class ChannelPrior(Stored):
    """Terms, at most one of each kind; isotropic waves and noise are always there."""

    terms: tuple[ChannelTerm, ...]

    def find_term(self, kind: type[T]) -> T | None:
        """Return the term of a kind, where there is one."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def __getitem__(self, kind: type[T]) -> T:
        term = self.find_term(kind)
        if term is None:
            raise KeyError(kind.__name__)
        return term

    def with_terms(self, *terms: ChannelTerm) -> ChannelPrior:
        """Return the prior with these in place of their kinds;
        those without powers are left out.
        """
        by_class = {type(term): term for term in (*self.terms, *terms)}
        # In the order of `KINDS`: parameters of terms stand one after the other in vectors.
        ordered = (
            by_class[fromkey]
            for fromkey in dict.fromkeys([*KINDS, *by_class])
            if fromkey in by_class
        )
        return ChannelPrior(tuple(term for term in ordered if len(term.power)))

    def change_frame(self, **numbers: Any) -> ChannelPrior:
        """Return the prior with some numbers of `frame` changed."""
        frame = replace(self.frame, **numbers)
        return ChannelPrior(tuple(replace(term, frame=frame) for term in self.terms))

    @property
    def frame(self) -> Frame:
        """What all terms share."""
        return self.terms[0].frame

    @property
    def signals(self) -> tuple[ChannelTerm, ...]:
        """Terms of the place."""
        return tuple(term for term in self.terms if term.is_signal)

    @property
    def is_real(self) -> bool:
        """Whether all covariances are."""
        return all(term.is_real for term in self.terms)

    @property
    def power(self) -> Tensor:
        """All powers (P,)."""
        return torch.cat([term.power for term in self.terms])

    @property
    def noise(self) -> float:
        """Power of the white noise."""
        return float(self[Noise].power)

    @property
    def disturbance_variance(self) -> Tensor:
        """Variance () of what is no signal."""
        return torch.cat([term.power for term in self.terms if not term.is_signal]).sum()

    def end_covariances(self, a: Sequence[SlotPlaces], b: Sequence[SlotPlaces]) -> Iterator[Tensor]:
        """Yield covariances (n, m) complex128 of several ends' signals,
        see `ChannelTerm.end_covariances`.
        """
        for parts in zip(*(term.end_covariances(a, b) for term in self.signals), strict=True):
            # From the first part on: `0 + tensor` would copy a matrix for nothing.
            yield sum(parts[1:], parts[0]).to(torch.complex128)

    def signal_covariances(self, groups: Sequence[Group]) -> list[Tensor]:
        """Return covariances (n, n) complex128 of groups' signals;
        what equal places share is made once.
        """
        alike: dict[tuple[bytes, float], list[int]] = {}
        for number, group in enumerate(groups):
            alike.setdefault((group.displacement_key, group.slot.wavenumber), []).append(number)
        result: list[Tensor] = [torch.empty(0)] * len(groups)
        for numbers in alike.values():
            alike_groups = [groups[number] for number in numbers]
            for number, covariance in zip(
                numbers, self.end_covariances(alike_groups, alike_groups), strict=True
            ):
                result[number] = covariance
        return result

    def disturbance(self, group: Group) -> Tensor:
        """Return the covariance (n, n) float64 of what is no signal of the place."""
        parts = [term.covariance(group, group) for term in self.terms if not term.is_signal]
        return sum(parts[1:], parts[0])

    def variance(self, at: SlotPlaces) -> Tensor:
        """Return the variance (n,) of the signal."""
        parts = [term.variance(at) for term in self.signals]
        return sum(parts[1:], parts[0])
