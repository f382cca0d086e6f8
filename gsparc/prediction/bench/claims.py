"""What is timed, and the ratios that are promised, each against its counterpart in the same rounds."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from gsparc.ops.projection import Projection
from gsparc.prediction.bench import kernels, layers
from gsparc.prediction.bench.measure import Call, Case, Machine, measure, timed, undisturbed
from gsparc.prediction.bench.scene import NETWORK, scene
from gsparc.prediction.timing import ClockSettings

log = logging.getLogger(__name__)

MOVING = (kernels.plan, kernels.moving, kernels.weights)  # a batch is as many plans
RASTERIZER = (*MOVING[:2], kernels.frozen, kernels.backward, kernels.weights)
MOST_PLANNED = 1_000_000  # Gaussians times poses in one call
# Of forward / limit: for fewer Gaussians than MANY, and for more. Where it comes from: docs/kernels.md.
FORWARD: dict[Projection, tuple[float, float]] = {"tangent": (4.0, 5.0), "equirect": (3.0, 4.0)}
MANY = 25_000
FROZEN = 1.5  # times the bytes that it must read


def cases(counts: Sequence[int], projections: Sequence[Projection], batches: Sequence[int]) -> Iterator[Case]:
    """Yield all rows of the table, one alive at a time."""
    for count in counts:
        for projection in projections:
            field = scene(count, projection)
            for make in RASTERIZER:
                for batch in batches:
                    if make in MOVING and count * batch > MOST_PLANNED:
                        log.info("%s of %d x %d Gaussians left out: too long", make.__name__, batch, count)
                        continue
                    yield make(field, batch)
            yield layers.channel(field, 1, 1)
            yield layers.channel(field, *layers.MANY)
        for batch in batches:
            yield layers.emission(count, batch)
            yield layers.emission(count, batch, NETWORK)
            yield layers.emission_backward(count, batch)
    for batch in batches:
        yield layers.loss(batch)
    for projection in projections:
        yield layers.step(projection)


@dataclass(frozen=True)
class Claim:
    """A promised ratio.

    Attributes:
        name: what is promised.
        ratio: one time over the other, both of the same rounds.
        bound: what the ratio is compared with.
        at_least: whether the ratio must be at least, rather than at most, the bound.
    """

    name: str
    ratio: float
    bound: float
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether the promise holds in this run."""
        return self.ratio >= self.bound if self.at_least else self.ratio <= self.bound


@torch.no_grad()
def claims(
    projection: Projection, counts: Sequence[int], threads: int, machine: Machine, clock: ClockSettings
) -> list[Claim]:
    """Measure every promise for one projection; `counts` ascending, the middle one of static receivers."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        fields = [scene(count, projection) for count in counts]
        middle, results = fields[len(fields) // 2], []
        size = len(middle)
        ratio = _ratio(kernels.backward(middle, 1).kernel, kernels.moving(middle, 1).kernel, clock)
        results.append(Claim(f"backward / forward at {size}", ratio, 3.0))
        for field in fields[1:]:
            bound = FORWARD[projection][len(field) > MANY]
            results.append(_limit("forward / limit", kernels.moving(field, 1), bound, machine, clock))
        times = _times({"moving": kernels.moving(middle, 1), "frozen": kernels.frozen(middle, 1)}, clock)
        results.append(Claim(f"moving / frozen at {size}", times["moving"] / times["frozen"], 3.0, True))
        for field in fields[1:]:
            results.append(_limit("frozen / bytes", kernels.frozen(field, 1), FROZEN, machine, clock))
        return [*results, _learning(projection)]
    finally:
        torch.set_num_threads(before)


def _limit(name: str, case: Case, bound: float, machine: Machine, clock: ClockSettings) -> Claim:
    over = measure(case, machine, None, clock, references=False).over
    return Claim(f"{name} at {case.count}", over, bound)


def _learning(projection: Projection) -> Claim:
    """A step takes the same way in either, to 1e-4: what it costs less, a given accuracy costs less."""
    case = layers.step(projection)
    assert case.reference is not None
    ratio = _ratio(case.reference, case.kernel, ClockSettings(rounds=3, least=2, warmup=1, budget_s=2.0))
    return Claim(f"training step, PyTorch / kernels at {case.count}", ratio, 2.0, True)


def _ratio(above: Call, below: Call, clock: ClockSettings) -> float:
    times = timed({"above": above, "below": below}, clock)
    return undisturbed(times["above"]) / undisturbed(times["below"])


def _times(cases: dict[str, Case], clock: ClockSettings) -> dict[str, float]:
    """Whole queries, from positions to predictions."""
    times = timed({name: case.whole for name, case in cases.items()}, clock)
    return {name: undisturbed(values) for name, values in times.items()}
