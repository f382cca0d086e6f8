"""Ensemble of searches of a counted effort, in parallel on the available threads."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from itertools import takewhile

import torch
from torch import Tensor

from gsparc.models.image_sources.clutter.search import add_clutter
from gsparc.models.image_sources.gp_likelihood import GainPosterior, estimate_phases
from gsparc.models.image_sources.refine import POLISHING_STEPS, learn_visibility, refine_scene
from gsparc.models.image_sources.rows import Rows
from gsparc.models.image_sources.scene import KernelVisibility, SourceScene
from gsparc.models.image_sources.search import Found, Search, SearchSettings
from gsparc.processes.worker import Cancelled, cancel_when, end_when, step_limit
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)

IN_VAIN = 0.9  # of the power left out: two such searches, and no others begin
QUADRATURE = 0.4  # initial `SourceScene.quadrature`
# leave-one-out error of two searches below which no third is started: 24 dB
CONVERGED_ERROR = 0.004
ROUNDS_SHARE = 0.9  # of a search's effort, after which no round adds sources
SHARPNESS = 4  # weight of a fit = error^-4: 1.5 times the error weighs a fifth
# Of a search, with phases, and whether all its sources are found.
Look = Callable[[Rows, SourceScene, bool], None]
COMPACT_M = 0.5  # [m], extent of a static array up to which clutter occludes its antennas alike


@dataclass(frozen=True)
class Member:
    """Result of one search.

    Attributes:
        scene: with phases.
        left_out: NMSE of its own rows, each receiver predicted from the others.
        number: of the search, from 0.
    """

    scene: SourceScene
    left_out: float
    number: int = 0


def run_searches(
    row_sets: list[Rows],
    transmitter: Tensor,
    settings: SearchSettings,
    noise_floor: float,
    effort: Effort,
    look: Look | None = None,
    start: Found | None = None,
) -> list[Member]:
    """Run one search per set of rows, best first; at least one.

    The first two that have reached the noise floor are the last: searches of higher numbers do not
    start, or end without a result, whichever of them is finished first.

    Args:
        row_sets: rows of each search, unit mean power, about the middle of the scene.
        transmitter: (3,) float64 [m], in the same frame.
        settings: of every search.
        noise_floor: known variance of the noise, in units of the rows' power.
        effort: of each.
        look: at the first search after each of its rounds, and after the last.
        start: sources that each starts from.

    Raises:
        Behind: a look says so.
        KeyboardInterrupt: by the user, within a step of each search.
    """
    errors: dict[int, float] = {}
    stopped = threading.Event()

    def is_share_spent(share: float) -> Callable[[], bool]:
        """Tell whether so much of a search's effort, from now, is spent."""
        return step_limit(round(share * effort.evaluations))

    def is_unwanted(number: int) -> bool:
        """Tell whether those before it are all that is wanted."""
        before = [
            errors[number_before] for number_before in takewhile(errors.__contains__, range(number))
        ]
        # As where each row has its own phase
        in_vain = sum(error > IN_VAIN for error in before) >= 2
        return stopped.is_set() or in_vain or reached_noise_floor(before, noise_floor)

    def run_search(number: int) -> Member:
        """Return sources, their phases, and the clutter that the noise does not hide."""
        rows, ended = row_sets[number], is_share_spent(ROUNDS_SHARE)

        def look_then_has_ended() -> bool:
            if look is not None and number == 0:
                look(rows, estimate_phases(rows, search.scene, QUADRATURE, noise_floor), False)
            return ended()

        search = Search(rows, transmitter, settings, number, look_then_has_ended, start)
        scene = estimate_phases(rows, search.run(), QUADRATURE, noise_floor)
        scene = refine_scene(
            rows, learn_visibility(rows, scene, KernelVisibility()), POLISHING_STEPS
        )
        if look is not None and number == 0:
            look(rows, scene, True)
        error = left_out_nmse(rows, scene)
        hidden = scene.quadrature == 1 or reached_noise_floor([error], noise_floor, 1)
        if settings.clutter and not hidden and occludes_antennas_alike(rows):
            scene = add_clutter(rows, scene, torch.Generator().manual_seed(settings.seed + number))
            error = left_out_nmse(rows, scene)
        return Member(scene, error, number)

    def run_unless_unwanted(number: int) -> Member | None:
        if is_unwanted(number):
            return None
        try:
            with cancel_when(partial(is_unwanted, number)), end_when(is_share_spent(1.0)):
                member = run_search(number)
        except Cancelled:
            return None
        scene = member.scene
        log.info(
            "search %d of %d: %d sources over %d planes, error %.3f",
            number + 1,
            len(row_sets),
            len(scene.sequences),
            len(scene.planes),
            member.left_out,
        )
        errors[number] = member.left_out
        return member

    threads = torch.get_num_threads()
    # Parallel searches scale better than threaded factorisations of a few hundred rows.
    torch.set_num_threads(1)
    pool = ThreadPoolExecutor(max(1, min(threads, len(row_sets))))
    try:
        running = [pool.submit(run_unless_unwanted, number) for number in range(len(row_sets))]
        wait(running, return_when=FIRST_EXCEPTION)
        members = [
            m
            for number, future in enumerate(running)
            if (m := future.result()) and not is_unwanted(number)
        ]
    finally:
        stopped.set()
        pool.shutdown(cancel_futures=True)  # waits for the step of each search
        torch.set_num_threads(threads)
    return sorted(members, key=lambda member: member.left_out)


def weights_of_fits(errors: Tensor) -> Tensor:
    """Return weights (K,) of fits by their errors (K,) at rows that they were fitted to,
    each left out alone.

    Products of errors would overrate a mean of searches, whose errors are small because they were
    searched for: test errors went 10 % up and down.
    """
    return torch.softmax(-SHARPNESS * errors.log(), 0)


def refine_member(rows: Rows, member: Member) -> Member:
    """Return a search's result on rows that have changed a little."""
    scene = refine_scene(rows, member.scene, POLISHING_STEPS)
    return Member(scene, left_out_nmse(rows, scene), member.number)


def left_out_nmse(rows: Rows, scene: SourceScene) -> float:
    """Return the NMSE of the rows, each receiver predicted from the others."""
    error = rows.target - GainPosterior(rows, scene).predict_left_out()
    return float(error.abs().square().sum() / rows.target.abs().square().sum())


def occludes_antennas_alike(rows: Rows) -> bool:
    """Tell whether the static end's antennas are near enough to be occluded alike."""
    return rows.array is None or float((rows.array.amax(0) - rows.array.amin(0)).norm()) < COMPACT_M


def reached_noise_floor(left_out: Sequence[float], noise_floor: float, count: int = 2) -> bool:
    """Tell whether `count` searches have reached the noise floor."""
    return sum(error < max(CONVERGED_ERROR, 2 * noise_floor) for error in left_out) >= count
