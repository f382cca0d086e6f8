"""The complex vectors behind published spectra: least squares on lags, then Levenberg-Marquardt.

A spectrum `g |A^H h| + o` (gain g absorbed into h, offset o only when the minimum was subtracted)
fixes h up to a global phase and, for arrays symmetric about a point,
its twin `conj(h)` in reversed element order.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.physics.array_response import make_co_array
from gsparc.processes.factor import Factor
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)

SEEDED = 4  # one row in this many starts at random, the others from their solved neighbours
NEIGHBOURS = 4  # solved neighbours that a row starts from
STARTS = (24, 48, 96, 384)  # random starts of the rows still unsolved, round by round
SCREENING, ITERATIONS = 12, 60  # iterations until most starts end, and of the others
GOES_ON = 8  # one start in this many goes on after the screening, and at least half as many
AT_ONCE = 1536  # starts of all rows that are searched together: memory
# A residual within the lags this many quantisation errors large is consistent with zero
ENOUGH = 1.0
SUSPECT = 4.0  # misfit over quantisation error above which an image is reported


@dataclass(frozen=True)
class RecoveredVectors:
    """Array vectors of n spectra.

    Attributes:
        vectors: (n, M) complex128, scaled so that `|A^H h|` is the published spectrum (plus
            `offset`).
        offset: (n,) what was subtracted before publishing; 0 unless the normalisation is `minmax`.
        residual: (n,) root mean square over pixels of `|A^H h|^2 - image^2`, the part inside the
            lags.
        floor: (n,) the same for the part that no array vector can explain.
        expected: (n,) the same as quantisation alone would make it.
    """

    vectors: np.ndarray
    offset: np.ndarray
    residual: np.ndarray
    floor: np.ndarray
    expected: np.ndarray

    @property
    def is_suspect(self) -> np.ndarray:
        """(n,) bool: the array cannot have measured this image, or the solver did not converge."""
        return np.hypot(self.residual, self.floor) > SUSPECT * self.expected


def recover_vectors(
    site: Site,
    images: np.ndarray,
    positions: np.ndarray,
    seed: int = 0,
    max_restarts: int = Effort.restarts,
) -> RecoveredVectors:
    """Return array vectors of spectra.

    Args:
        site: array, wavelength, grid and normalisation.
        images: (n, H, W) uint8 (255 = 1) or float.
        positions: (n, 3) [m] of the transmitter; neighbours start each other's search.
        seed: of the random starts.
        max_restarts: every row is solved once from its neighbours or from random starts; of
            restarts there are at most so many, rows times starts,
            as spectra of another array never converge.
    """
    problem = _Problem.from_images(site, images)
    generator = torch.Generator().manual_seed(seed)
    n = len(images)
    state = torch.zeros(n, problem.dimension, dtype=torch.float64)
    cost = torch.full((n,), torch.inf).double()
    enough = (ENOUGH * problem.expected) ** 2

    def keep_better(rows: Tensor, solutions: tuple[Tensor, Tensor]) -> None:
        better = solutions[1] < cost[rows]
        state[rows[better]], cost[rows[better]] = solutions[0][better], solutions[1][better]

    numbers = torch.arange(n)
    order = torch.from_numpy(np.random.default_rng(seed).permutation(n))
    for turn, starts in enumerate(STARTS):
        unsolved = order[cost[order] > enough[order]]
        if turn == 0:
            unsolved = unsolved[: -(-n // SEEDED)]
        if turn > 1:
            unsolved = unsolved[: max_restarts // starts]
            max_restarts -= starts * len(unsolved)
        if not len(unsolved):
            break
        for rows in unsolved.split(max(1, AT_ONCE // starts)):
            drawn = problem.draw_flat_starts(rows, starts, generator)
            keep_better(rows, _minimise(problem, rows, drawn, enough))
        while len(rows := numbers[cost > enough]):
            solved = (cost <= enough).numpy()
            near = _nearest_solved(positions, rows.numpy(), solved)
            if near is None:
                break
            before = int(solved.sum())
            few = AT_ONCE // NEIGHBOURS
            for part, around in zip(rows.split(few), near.split(few), strict=True):
                keep_better(part, _minimise(problem, part, state[around].flatten(0, 1), enough))
            if int((cost <= enough).sum()) - before < max(1, len(rows) // 20):
                break
        log.debug(
            "%d of %d spectra unsolved after %d starts each", int((cost > enough).sum()), n, starts
        )
    for rows in numbers.split(AT_ONCE):
        keep_better(
            rows, _minimise(problem, rows, state[rows], torch.zeros_like(enough), SCREENING)
        )
    return problem.to_vectors(state, cost)


def _nearest_solved(positions: np.ndarray, rows: np.ndarray, solved: np.ndarray) -> Tensor | None:
    """Rows (len(rows), <= NEIGHBOURS) of the nearest solved spectra; None when there is none."""
    solved_rows = np.flatnonzero(solved)
    if not len(solved_rows):
        return None
    wanted = np.arange(1, min(NEIGHBOURS, len(solved_rows)) + 1)
    return torch.from_numpy(
        solved_rows[cKDTree(positions[solved_rows]).query(positions[rows], k=wanted)[1]]
    )


@dataclass(frozen=True)
class _Problem:
    """Sums of squares in whitened lag coordinates: `|v S v - (z2 + 2 o z1 + o^2 z0)|^2`.

    Attributes:
        forms: (2 M, K * 2 M) S for one product, K the number of lag numbers.
        z2, z1: (n, K) lag coordinates of image^2 and image; z0: (K,) of the constant 1.
        floor, expected: (n,) see Recovered.
        offsets: whether o is unknown (else 0).
    """

    forms: Tensor
    z2: Tensor
    z1: Tensor
    z0: Tensor
    floor: Tensor
    expected: Tensor
    offsets: bool

    @staticmethod
    def from_images(site: Site, images: np.ndarray) -> _Problem:
        array, grid, wavelength = site.array_geometry()
        co_array = make_co_array(array, wavelength)
        basis = co_array.spectrum_basis(grid, wavelength)
        # Whitened: squares of lag coordinates are mean squares over pixels.
        q, r = torch.linalg.qr(basis / len(basis) ** 0.5)
        forms = torch.einsum("ij,jkl->ikl", r, co_array.quadratic_forms())
        projector = q / len(basis) ** 0.5
        parts = []
        eight_bits = images.dtype == np.uint8
        full = np.iinfo(np.uint8).max if eight_bits else 1
        step = 1 / full if eight_bits else 1e-4
        for block in np.array_split(images, max(1, len(images) // AT_ONCE)):
            image = torch.from_numpy(block.reshape(len(block), -1)).double() / full
            z2, z1 = image.square() @ projector, image @ projector
            outside = image.square().square().mean(1) - z2.square().sum(1)
            # A rounding error e of the amplitude a is 2 a e of its square.
            rounding = 2 * image.square().mean(1).sqrt() * step / 12**0.5
            parts.append((z2, z1, outside.clamp_min(0).sqrt(), rounding))
        z2, z1, floor, expected = (torch.cat(part) for part in zip(*parts, strict=True))
        flat = forms.permute(1, 0, 2).reshape(len(forms[0]), -1).contiguous()
        minmax = site.normalisation == "minmax"
        return _Problem(flat, z2, z1, projector.sum(0), floor, expected.clamp_min(1e-9), minmax)

    @property
    def dimension(self) -> int:
        return len(self.forms) + (1 if self.offsets else 0)

    def draw_flat_starts(self, rows: Tensor, starts: int, generator: torch.Generator) -> Tensor:
        """Return starting points (len(rows) * starts, unknowns) of about the spectra's power."""
        start = torch.randn(
            len(rows), starts, self.dimension, generator=generator, dtype=torch.float64
        )
        # z2[0] is the mean square of the image up to sign:
        # the first whitened column is the constant.
        start *= (self.z2[rows, :1].abs() / len(self.forms)).sqrt()[:, :, None]
        return start.flatten(0, 1)

    def errors_and_slopes(self, state: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return errors (B, K) and their slopes (B, K, unknowns)."""
        v = state[:, : len(self.forms)]
        half = (v @ self.forms).view(len(v), -1, v.shape[1])
        error = torch.bmm(half, v[:, :, None]).squeeze(2) - self.z2[rows]
        if not self.offsets:
            return error, 2 * half
        o = state[:, -1:]
        error = error - 2 * o * self.z1[rows] - o.square() * self.z0
        return error, torch.cat([2 * half, (-2 * self.z1[rows] - 2 * o * self.z0)[:, :, None]], 2)

    def to_vectors(self, state: Tensor, cost: Tensor) -> RecoveredVectors:
        m = len(self.forms) // 2
        vectors = torch.complex(state[:, :m], state[:, m : 2 * m]).numpy()
        offset = state[:, -1].numpy() if self.offsets else np.zeros(len(state))
        residual, floor, expected = (v.numpy() for v in (cost.sqrt(), self.floor, self.expected))
        return RecoveredVectors(vectors, offset, residual, floor, expected)


def _minimise(
    problem: _Problem, rows: Tensor, start: Tensor, tolerance: Tensor, iterations: int = ITERATIONS
) -> tuple[Tensor, Tensor]:
    """Best of several starts per row: state (n, unknowns) and sum of squared errors (n,).

    Levenberg-Marquardt with all starts of all rows in one batch; after a few iterations only the
    best ones continue, and rows at the quantisation floor end.
    """
    n, starts = len(rows), len(start) // len(rows)
    best = torch.zeros(n, problem.dimension, dtype=torch.float64)
    best_cost = torch.full((n,), torch.inf).double()
    owner = torch.arange(n).repeat_interleave(starts)
    state, damping = start.clone(), torch.full((len(start),), 1e-2, dtype=torch.float64)
    error, slope = problem.errors_and_slopes(state, rows[owner])
    cost = error.square().sum(1)
    for iteration in range(iterations):
        normal = slope.transpose(1, 2) @ slope
        lift = damping * normal.diagonal(dim1=1, dim2=2).mean(1) + 1e-12
        normal.diagonal(dim1=1, dim2=2).add_(lift[:, None])
        step = (
            Factor.from_gram(normal, "ignore")
            .solve(slope.transpose(1, 2) @ error[:, :, None])
            .squeeze(2)
        )
        new_state = state - step
        new_error, new_slope = problem.errors_and_slopes(new_state, rows[owner])
        new_cost = new_error.square().sum(1)
        better = new_cost < cost
        state = torch.where(better[:, None], new_state, state)
        error = torch.where(better[:, None], new_error, error)
        slope = torch.where(better[:, None, None], new_slope, slope)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better, damping * 0.4, damping * 3).clamp_min(1e-9)
        stuck = damping >= 1e2
        lowest = torch.full((n,), torch.inf).double().scatter_reduce(0, owner, cost, "amin")
        improved = lowest < best_cost
        least = torch.nonzero(cost <= lowest[owner]).squeeze(1)
        first = torch.zeros(n, dtype=torch.int64).scatter_(0, owner[least], least)
        best[improved], best_cost[improved] = state[first[improved]], lowest[improved]
        done = best_cost <= tolerance[rows]
        going = ~done[owner] & ~stuck
        if iteration == SCREENING and starts > GOES_ON:
            # Ranks within each row's own starts: rows are set apart by more than any cost.
            rank = torch.argsort(torch.argsort(cost + owner * (cost.max() + 1)))
            count = torch.bincount(owner, minlength=n)
            place = rank - (count.cumsum(0) - count)[owner]
            going &= place < max(GOES_ON // 2, starts // GOES_ON)
        if not going.any():
            break
        if not going.all():
            state, error, slope, cost = state[going], error[going], slope[going], cost[going]
            damping, owner = damping[going], owner[going]
    return best, best_cost
