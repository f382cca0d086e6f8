"""Ensemble of searches within a time budget, in parallel on the available threads."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import torch
from torch import Tensor

from gsparc.methods.time_budget import TimeBudget
from gsparc.multipath import refine_phase
from gsparc.multipath.clutter.search import find_clutter
from gsparc.multipath.phased_gp import PhasedPosterior, PhasedScene
from gsparc.multipath.rows import Rows
from gsparc.multipath.search import Search, SearchSettings
from gsparc.multipath.search_cache import Member, SearchCache

log = logging.getLogger(__name__)

QUADRATURE = 0.4  # initial `PhasedScene.quadrature`
SHARPNESS = 4  # weight of a search = (leave-one-out error)^-4: 1.5 times the error weighs a fifth
CONVERGED_ERROR = 0.004  # leave-one-out error of two searches below which no third is started: 24 dB
LAST_START, ROUNDS_END = 0.6, 0.8  # of the budget: no search starts, no search adds sources after


def search_many(
    row_sets: list[Rows],
    transmitter: Tensor,
    settings: SearchSettings,
    seed: int,
    noise_floor: float,
    budget: TimeBudget,
    clutter: bool,
    cache: SearchCache,
    stage: str = "search",
) -> list[Member]:
    """One search per set of rows, best first; at least one, others while the budget lasts.

    No further search starts once two have reached the noise floor.

    Args:
        row_sets: rows of each search, unit mean power, about the middle of the scene.
        transmitter: (3,) float64 [m], in the same frame.
        settings: of every search.
        seed: of the first search; the others count on.
        noise_floor: known variance of the noise, in units of the rows' power.
        budget: of all together; see `LAST_START` and `ROUNDS_END`.
        clutter: search for occluding boxes and finite mirrors, too.
        cache: of finished searches, under the name of `stage`.
        stage: distinguishes searches of one fit.
    """
    threads = torch.get_num_threads()
    errors: list[float] = []

    def search(number: int) -> Member | None:
        if done := cache.find(f"{stage} {number}"):
            return done
        if at_noise_floor(errors, noise_floor) or (number > 0 and budget.over(LAST_START)):
            return None
        rows = row_sets[number]
        scene = Search(rows, transmitter, settings, seed + number, partial(budget.over, ROUNDS_END)).run()
        phased = PhasedScene.of(rows, scene, QUADRATURE)
        phased = refine_phase.learn_visibility(rows, phased, 10, settings.visibility, noise_floor)
        phased = refine_phase.refine(rows, phased, 20, noise_floor)
        if clutter and phased.quadrature < 1:
            generator = torch.Generator().manual_seed(seed + number)
            phased = find_clutter(rows, phased, generator, late=budget.over, noise_floor=noise_floor)
        error = rows.target - PhasedPosterior(rows, phased, noise_floor).left_out()
        left_out = float(error.abs().square().sum() / rows.target.abs().square().sum())
        log.info(
            "search %d of %d: %d sources over %d planes, error %.3f, %.0f of %.0f s",
            number + 1, len(row_sets), len(scene.words), len(scene.planes), left_out,
            budget.spent, budget.seconds,
        )  # fmt: skip
        member = Member(phased, left_out)
        errors.append(left_out)
        cache.put(f"{stage} {number}", member, budget.limited_by)
        return member

    # Parallel searches scale better than threaded factorisations of a few hundred rows.
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(max(1, min(threads, len(row_sets)))) as pool:
            found = [member for member in pool.map(search, range(len(row_sets))) if member is not None]
    finally:
        torch.set_num_threads(threads)
    return sorted(found, key=lambda member: member.left_out)


def at_noise_floor(left_out: Sequence[float], noise_floor: float) -> bool:
    """Whether two searches have reached the noise floor."""
    return sum(error < max(CONVERGED_ERROR, 2 * noise_floor) for error in left_out) > 1


def ensemble_weights(members: list[Member]) -> Tensor:
    """Weights of the searches in the average, (M,) float32 of sum 1."""
    error = torch.tensor([max(member.left_out, 1e-6) for member in members])
    return torch.softmax(-SHARPNESS * error.log(), 0)
