"""Several searches within a time budget, side by side on the threads there are."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.multipath.clutter.search import furnish
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene
from gsparc.multipath.refine_phase import settle
from gsparc.multipath.rows import Rows
from gsparc.multipath.search import Search, SearchSettings
from gsparc.multipath.search_cache import Shelf

log = logging.getLogger(__name__)

TURNING = 0.4  # share of a gain's variation that is not along its phase, before it is learned
SHARPNESS = 4  # weight of a search = (left-out error)^-4: half the error again counts a fifth
ENOUGH = 0.004  # left-out error of two searches below which no third is started: 24 dB
LAST_START, ROUNDS_END = 0.6, 0.8  # of the budget: no search starts, no search adds sources after


@dataclass(frozen=True)
class Budget:
    """Wall-clock time for searching.

    Attributes:
        started: `time.monotonic()` of the fit.
        seconds: for all searches; see `LAST_START` and `ROUNDS_END`.
    """

    started: float
    seconds: float

    @property
    def spent(self) -> float:
        """[s]"""
        return time.monotonic() - self.started


@dataclass(frozen=True)
class Member:
    """What one search found.

    Attributes:
        phased: the scene.
        left_out: NMSE of its own rows, each receiver predicted from the others.
    """

    phased: PhasedScene
    left_out: float


def search_many(
    draw: list[Rows],
    transmitter: Tensor,
    settings: SearchSettings,
    seed: int,
    noise_floor: float,
    budget: Budget,
    furniture: bool = False,
    shelf: Shelf | None = None,
    stage: str = "search",
) -> list[Member]:
    """One search on each of the drawn rows, best first; at least one, others while the budget lasts.

    None is started any more once two have ended at the noise floor: they would say the same.

    Args:
        draw: rows of each search, unit mean power, about the middle of the scene.
        transmitter: (3,) float64 [m], in the same frame.
        settings: of every search.
        seed: of the first search; the others count on.
        noise_floor: known variance of the noise, in units of the rows' power.
        budget: of all together.
        furniture: whether boxes and small mirrors are looked for, too.
        shelf: where finished searches are kept, under the name of `stage`; None keeps none.
        stage: tells searches of one fit apart.
    """
    threads = torch.get_num_threads()
    errors: list[float] = []

    def search(number: int) -> Member | None:
        done = None if shelf is None else shelf.find(f"{stage} {number}")
        if done is not None:
            return done
        if number > 0 and budget.spent > LAST_START * budget.seconds:
            return None
        if agreed(errors, noise_floor):
            return None
        rows = draw[number]
        deadline = budget.started + ROUNDS_END * budget.seconds
        scene = Search(rows, transmitter, settings, seed + number, deadline).run()
        phased = settle(
            rows, PhasedScene.of(rows, scene, TURNING), settings.visibility, noise_floor=noise_floor
        )
        if furniture and phased.turning < 1:
            generator = torch.Generator().manual_seed(seed + number)
            latest = budget.started + budget.seconds
            phased = furnish(rows, phased, generator, deadline=latest, noise_floor=noise_floor)
        error = rows.target - PhasedPosterior(rows, phased, noise_floor).left_out()
        left_out = float(error.abs().square().sum() / rows.target.abs().square().sum())
        log.info(
            "search %d of %d: %d sources over %d planes, error %.3f, %.0f of %.0f s",
            number + 1, len(draw), len(scene.words), len(scene.planes), left_out,
            budget.spent, budget.seconds,
        )  # fmt: skip
        member = Member(phased, left_out)
        errors.append(left_out)
        if shelf is not None:
            shelf.put(f"{stage} {number}", member)
        return member

    # Matrices of a few hundred rows gain little from two threads; two searches do.
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(max(1, min(threads, len(draw)))) as pool:
            found = [member for member in pool.map(search, range(len(draw))) if member is not None]
    finally:
        torch.set_num_threads(threads)
    return sorted(found, key=lambda member: member.left_out)


def agreed(left_out: Sequence[float], noise_floor: float) -> bool:
    """Whether two searches ended at the noise floor, so that another one would say the same."""
    return sum(error < max(ENOUGH, 2 * noise_floor) for error in left_out) > 1


def weights(members: list[Member]) -> Tensor:
    """What each search counts in the average, (M,) float32 of sum 1."""
    error = torch.tensor([max(member.left_out, 1e-6) for member in members])
    return torch.softmax(-SHARPNESS * error.log(), 0)
