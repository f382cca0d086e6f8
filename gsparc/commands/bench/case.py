"""One row of the table: what is timed, and how much work it cannot avoid."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from torch import Tensor

Call = Callable[[], object]


@dataclass(frozen=True)
class Work:
    """What must be done whoever does it.

    Attributes:
        bytes: that must move once: inputs read and outputs written.
        pairs: pixel-Gaussian pairs inside the exact footprints, an exponential each.
    """

    bytes: int
    pairs: int = 0


@dataclass(frozen=True)
class Case:
    """An operation at one size.

    Attributes:
        name: what it does.
        projection: `tangent`, `equirect` or `-`.
        count: Gaussians N.
        batch: samples in one call.
        work: for the machine's limit.
        kernel: the operators alone, on prepared tensors.
        whole: from positions to predictions, modules and all; None where there is no such thing.
        reference: the same as `kernel` in plain PyTorch; None where it is not affordable.
        unaffordable: why there is no reference.
    """

    name: str
    projection: str
    count: int
    batch: int
    work: Work
    kernel: Call
    whole: Call | None = None
    reference: Call | None = None
    unaffordable: str = ""

    @property
    def key(self) -> str:
        """Where its numbers are kept in the summary, without the threads."""
        name = self.name.replace(",", "").replace(" ", "_")
        return f"{name}/{self.projection}/n{self.count}/b{self.batch}"


def size(tensors: Iterable[Tensor]) -> int:
    """Bytes of tensors."""
    return sum(tensor.nbytes for tensor in tensors)
