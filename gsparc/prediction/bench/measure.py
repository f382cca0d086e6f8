"""What is timed, how much work it cannot avoid, and its time beside the machine's own marks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsparc.ops import machine_limits
from gsparc.prediction.timing import ClockSettings, interleaved

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
    """Count the bytes of tensors."""
    return sum(tensor.nbytes for tensor in tensors)


COPY_BYTES = 48 * 2**20  # with its copy, beyond every cache
MARK_TASKS = 16  # of the bare exponential loop, a fraction of a millisecond


@dataclass(frozen=True)
class Row:
    """Times of one case on some threads.

    Attributes:
        case, threads: what was timed.
        kernel, whole: wall times of every round [ms]; whole is None where the case has none.
        limit: the machine's limit by its marks in the same rounds [ms].
        over: kernel time over the limit.
        bound: what the limit comes from, `bytes` or `pairs`.
        reference: one call in plain PyTorch [ms], or None.
    """

    case: Case
    threads: int
    kernel: np.ndarray
    whole: np.ndarray | None
    limit: float
    over: float
    bound: str
    reference: float | None


def timed(calls: Mapping[str, Call | None], clock: ClockSettings) -> dict[str, np.ndarray]:
    """Time calls in turns [ms]; None is left out."""
    known = {name: call for name, call in calls.items() if call is not None}
    # A default argument binds each call: the closure alone would call the last one for all.
    return interleaved({name: lambda turn, call=call: call() for name, call in known.items()}, clock)  # type: ignore[misc]


def undisturbed(times: np.ndarray) -> float:
    """Return the fastest fifth of the rounds: other processes stretch long calls more than short ones."""
    return float(np.quantile(times, 0.2))


class Machine:
    """The marks: a copy that no cache holds, and bare exponentials."""

    def __init__(self) -> None:
        self._source = torch.ones(COPY_BYTES // 4)
        self._target = torch.zeros_like(self._source)

    def copy(self) -> int:
        """Copy; return the bytes moved."""
        return machine_limits.copy(self._source, self._target)

    def exponentials(self) -> int:
        """Evaluate exponentials; return how many."""
        return machine_limits.exponentials(MARK_TASKS)


@torch.no_grad()
def measure(
    case: Case, machine: Machine, threads: int | None, clock: ClockSettings, *, references: bool = True
) -> Row:
    """Time a case on `threads` threads (None: as now), everything once a round; the reference once."""
    before = torch.get_num_threads()
    threads = threads or before
    torch.set_num_threads(threads)
    try:
        # How much the two marks do in one call.
        moved, counted = machine.copy(), machine.exponentials()
        calls = {"kernel": case.kernel, "whole": case.whole}
        times = timed(calls | {"exponentials": machine.exponentials, "copy": machine.copy}, clock)
        # A dense reference may take seconds: after half a second no new round begins.
        once = ClockSettings(rounds=3, least=1, warmup=0, budget_s=0.5)
        reference = timed({"it": case.reference if references else None}, once).get("it")
    finally:
        torch.set_num_threads(before)
    by_bytes = undisturbed(times["copy"]) * case.work.bytes / moved
    by_pairs = undisturbed(times["exponentials"]) * case.work.pairs / counted
    # The roofline: at best memory and arithmetic overlap, and the slower one is the limit.
    limit = max(by_bytes, by_pairs)
    return Row(
        *(case, threads, times["kernel"], times.get("whole")), limit=limit,
        over=undisturbed(times["kernel"]) / limit, bound="pairs" if by_pairs > by_bytes else "bytes",
        reference=None if reference is None else float(np.median(reference)),
    )  # fmt: skip


def facts(row: Row) -> dict[str, float | str | None]:
    """Return flat keys of one row for the summary; times in milliseconds."""
    stem = f"bench/{row.case.key}/t{row.threads}"
    values: dict[str, float | str | None] = {
        f"{stem}/limit_ms": row.limit,
        f"{stem}/over_limit": row.over,
        f"{stem}/bound": row.bound,
        f"{stem}/pairs": row.case.work.pairs,
        f"{stem}/bytes": row.case.work.bytes,
        f"{stem}/reference_ms": row.reference,
    }
    for name, times in (("kernel", row.kernel), ("end_to_end", row.whole)):
        if times is not None:
            values[f"{stem}/{name}_ms_p50"] = float(np.median(times))
            values[f"{stem}/{name}_ms_p95"] = float(np.quantile(times, 0.95))
    return values
