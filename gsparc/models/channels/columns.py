"""Channels as groups of columns: those of one static place,
one set of moving places and one wavelength.

Columns of one group share a covariance. Groups share its parameters but not their scales, and are
otherwise independent: an antenna half a metre on hears another field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.schema import LIGHT, Measurements, Site
from gsparc.models.run_factors import best_run_factors, factor_matrix
from gsparc.ops.transforms import to_numpy
from gsparc.physics.waves import NEAR_M
from gsparc.processes.conditioned import Conditioned
from gsparc.processes.density import TINY
from gsparc.processes.factor import Factor
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.processes.places import ORIGIN, UNKNOWN

# Tones whose phases turn no more than this against each other over all places are one band
BAND_RAD = 1.0


@dataclass(frozen=True)
class Slot:
    """Which entries of a channel a group is, and where they are measured.

    Attributes:
        station: number of the static end, 0 where there is one.
        antennas, tones: entries of the channel (A, K), which are all pairs of the two.
        end: (3,) float64 static place [m], local; NaN where unknown.
        element: (3,) float64 place of the moving antenna in the receiver's frame [m].
        wavenumber: [rad/m].
    """

    station: int
    antennas: tuple[int, ...]
    tones: tuple[int, ...]
    end: Tensor
    element: Tensor
    wavenumber: float

    def write_entries(self, target: Tensor, rows: Tensor, values: Tensor) -> None:
        """Write values (n, D) to `rows` of `target` (S, A, K)."""
        antennas, tones = torch.tensor(self.antennas), torch.tensor(self.tones)
        target[rows[:, None, None], antennas[None, :, None], tones[None, None]] = values.reshape(
            len(rows), len(antennas), len(tones)
        ).to(target.dtype)

    def antenna_places(self, moving: Tensor, rotation: Tensor) -> Tensor:
        """Return the antenna's places (B, 3) float64 [m]; of the moving end's (B, 3)
        and turns (B, 3, 3).
        """
        if not self.element.any():
            return moving
        return moving + rotation @ self.element

    def state(self) -> dict[str, Any]:
        """Return what `read` reads; a checkpoint holds finite numbers,
        so that an unknown place is none.
        """
        return {**vars(self), "end": self.end[:0] if self.end.isnan().any() else self.end}

    @classmethod
    def read(cls, state: dict[str, Any]) -> Slot:
        """Make the slot whose `state` this was."""
        end = state["end"] if len(state["end"]) else UNKNOWN
        entries = {name: tuple(int(n) for n in state[name]) for name in ("antennas", "tones")}
        return cls(**{**state, **entries, "end": end})


@dataclass(frozen=True)
class SlotPlaces:
    """Places of one slot.

    Attributes:
        slot: whose.
        places: (n, 3) float64 [m], or (n, 6) where both ends move.
    """

    slot: Slot
    places: Tensor


@dataclass(frozen=True)
class Group(SlotPlaces):
    """Training rows of one slot.

    Attributes:
        rows: (n,) int64 into the rows that were gathered.
        target: (n, D) complex128, stored units.
        run: (n,) int64 numbers of runs.
        order: (n,) float64 numbers among the static end's measurements, in the order they were
            taken.
    """

    rows: Tensor
    target: Tensor
    run: Tensor
    order: Tensor

    def __len__(self) -> int:
        return len(self.places)

    def select_rows(self, index: Tensor) -> Group:
        """Return the rows (m,) of these numbers."""
        return Group(self.slot, **{name: part[index] for name, part in self._tensors().items()})

    def thin_rows(self, limit: int) -> Group:
        """Return at most so many rows, drawn evenly."""
        # One seed for all: groups with equal places keep equal ones,
        # whose matrices are computed once.
        return self.select_rows(torch.from_numpy(sample_row_numbers(len(self), limit, 0)))

    def _tensors(self) -> dict[str, Tensor]:
        return {name: part for name, part in vars(self).items() if isinstance(part, Tensor)}

    def state(self, factors: Tensor) -> dict[str, Any]:
        """Return what `read` reads; targets as measured, of runs of these factors."""
        # Groups hold aligned targets, and `_fit_factors` divides by the factors again when read.
        target = self.target * factors[self.run][:, None]
        return {**self._tensors(), "slot": self.slot.state(), "target": target}

    @classmethod
    def read(cls, state: dict[str, Any]) -> Group:
        """Make the group whose `state` this was."""
        return cls(**{**state, "slot": Slot.read(state["slot"])})

    @cached_property
    def displacement_key(self) -> bytes:
        """Equal for groups whose places differ by one displacement at most, to a micrometre."""
        return to_numpy((self.places - self.places[0]).mul(1e6).round()).tobytes()


def require_waves(site: Site) -> None:
    """Raise a `ValueError` for data that waves of a known length cannot explain."""
    if not site.has_waves:
        raise ValueError(f"{site.name}: waves need complex channels (csi) of a known carrier")


def group_channels(data: Measurements, rows: np.ndarray, by_antenna: bool) -> tuple[Group, ...]:
    """Return groups of the given rows (n,).

    Args:
        data: kind csi; one end is static, or there are several static stations, or both ends move.
        rows: measurements; those with a masked entry of a group are no rows of that group.
        by_antenna: whether antennas with places of their own and far tones are groups of their own;
            else columns of a station are one, measured at the moving end's place at the carrier.
    """
    require_waves(data.site)
    # A copy of one station, or of all as one end that moves, sees one.
    order, station = _order_in_station(data), data.stations_of(rows) * data.site.several
    run = np.unique(data.runs_of(rows), return_inverse=True)[1].reshape(-1)
    moving = torch.from_numpy(np.asarray(data.moving[rows], np.float64))
    turned = torch.from_numpy(np.asarray(data.rx_rotation[rows], np.float64))
    target = torch.from_numpy(np.asarray(data.target[rows])).to(torch.complex128)
    groups = []
    for number in np.unique(station):
        mine = np.flatnonzero(station == number)
        for slot in _slots_of_station(data, int(number), rows[mine], by_antenna):
            entries = np.ix_(mine, np.array(slot.antennas), np.array(slot.tones))
            measured = mine if data.mask is None else mine[data.mask[rows][entries].all((1, 2))]
            if not len(measured):
                continue
            measured_rows = torch.from_numpy(measured)
            chosen = target[measured_rows][:, list(slot.antennas)][:, :, list(slot.tones)].reshape(
                len(measured_rows), -1
            )
            places = slot.antenna_places(moving[measured_rows], turned[measured_rows])
            when = torch.from_numpy(run[measured]), torch.from_numpy(order[rows[measured]])
            groups.append(Group(slot, places, measured_rows, chosen, *when))
    return tuple(groups)


def _order_in_station(data: Measurements) -> np.ndarray:
    """Each measurement's number (S,) float64 among those of its station, as they were taken."""
    station = data.stations_of()
    sequence = np.arange(len(data)) if data.sequence is None else data.sequence
    order = np.empty(len(data))
    for number in np.unique(station):
        mine = np.flatnonzero(station == number)
        order[mine] = np.argsort(np.argsort(sequence[mine]))
    return order


def _slots_of_station(
    data: Measurements, station: int, rows: np.ndarray, by_antenna: bool
) -> list[Slot]:
    site, (antennas, tones) = data.site, data.target.shape[1:]
    centre, carrier = (
        torch.from_numpy(site.every_station.position[station]),
        float(site.carriers[station]),
    )
    all_antennas = tuple(range(antennas))
    if not by_antenna:
        return [
            Slot(
                station,
                all_antennas,
                tuple(range(tones)),
                centre,
                ORIGIN,
                2 * math.pi * carrier / LIGHT,
            )
        ]
    # The longest way between places bounds how far two tones' phases turn against each other.
    reach = float(np.linalg.norm(np.ptp(data.moving[rows], axis=0)))
    frequency = site.tones() if len(site.tones()) == tones else np.full(tones, carrier)
    elements: list[tuple[tuple[int, ...], Tensor, Tensor]] = [(all_antennas, centre, ORIGIN)]
    if site.array is not None and antennas == len(site.array) and antennas > 1:
        offsets = torch.from_numpy(np.asarray(site.array, np.float64))
        rotation = torch.from_numpy(np.asarray(data.rx_rotation[rows[0]], np.float64))
        # Antennas of a moving receiver are offsets in its frame,
        # those of a static one are static ends.
        moves = site.static_end == "tx"
        both = [
            (centre, offset) if moves else (centre + rotation @ offset, ORIGIN)
            for offset in offsets
        ]
        elements = [((number,), *pair) for number, pair in enumerate(both)]
    slots = []
    for band in coherent_bands(frequency, reach):
        wavenumber = 2 * math.pi * float(frequency[list(band)].mean()) / LIGHT
        slots += [
            Slot(station, ports, band, end, element, wavenumber) for ports, end, element in elements
        ]
    return slots


def coherent_bands(frequency: np.ndarray, reach: float) -> list[tuple[int, ...]]:
    """Return tones (K,) [Hz] in bands within which a wave's phase differs
    by `BAND_RAD` over `reach` [m].
    """
    # Of rows at one place (1 mm) a band is 48 GHz wide: all tones.
    width = BAND_RAD * LIGHT / (2 * math.pi * max(reach, NEAR_M))
    number = np.floor((frequency - frequency.min()) / width).astype(int)
    return [tuple(np.flatnonzero(number == n).tolist()) for n in np.unique(number)]


def count_static_ends(groups: tuple[Group, ...]) -> int:
    """Return how many static ends there are."""
    return len({group.slot.station for group in groups})


def fit_run_factors(
    groups: tuple[Group, ...], covariances: list[Tensor], runs: int, factors: Tensor | None = None
) -> tuple[Tensor, list[tuple[Group, Conditioned]]]:
    """Return factors of runs (runs,) complex128, as measured over the largest's,
    and groups without them.

    Of several ends that share them phases alone: what a run has changed beside its phase is each
    end's own, and would be taken for a level of all.

    Args:
        groups: as measured.
        covariances: (n, n) of each, known up to a factor.
        runs: number.
        factors: of runs, estimated by likelihood unless given.
    """
    solved = [Factor.from_gram(covariance) for covariance in covariances]
    if factors is None:
        factors = (
            torch.ones(1, dtype=torch.complex128)
            if runs == 1
            else _fit_factors(groups, solved, runs)
        )
    solutions = []
    for group, factor in zip(groups, solved, strict=True):
        target = group.target / factors[group.run][:, None]
        solutions.append(
            (replace(group, target=target), Conditioned(factor, target, factor.solve(target)))
        )
    return factors, solutions


def negative_log_likelihood(factors: Tensor, known: list[tuple[Group, Conditioned]]) -> float:
    """Return the negative log likelihood [nats] of what `fit_run_factors` says,
    scales profiled out.
    """
    nll = 0.0
    for group, process in known:
        count, outputs = process.values.shape
        nll += outputs * (
            count * math.log(max(process.power, TINY)) + float(process.factor.log_determinant)
        )
        # Jacobian of the division by factors: without it the largest would be the likeliest.
        nll += 2 * outputs * float(factors.abs().log()[group.run].sum())
    return nll


def _fit_factors(groups: tuple[Group, ...], factors: list[Factor], runs: int) -> Tensor:
    quadratic, size = np.zeros((runs, runs), np.complex128), np.zeros(runs)
    for group, factor in zip(groups, factors, strict=True):
        run, level = group.run.numpy(), float(group.target.abs().square().mean())
        # In units of its own power, as groups have scales of their own.
        matrix = factor_matrix(factor.inverse.numpy(), group.target.numpy(), run) / max(level, TINY)
        quadratic[: len(matrix), : len(matrix)] += matrix
        size += np.bincount(run, minlength=runs) * group.target.shape[1]
    heard, estimates = size > 0, np.ones(runs, np.complex128)
    # `best_run_factors` tells what rows are to be multiplied by, the inverse of what they were.
    estimates[heard] = 1 / best_run_factors(quadratic[np.ix_(heard, heard)], size[heard])
    measured = torch.from_numpy(estimates)
    return measured / measured.abs() if count_static_ends(groups) > 1 else measured


def thin_groups(
    groups: tuple[Group, ...], max_groups: int, max_rows: int | None = None
) -> tuple[Group, ...]:
    """Return at most `max_groups` groups, spread over all, of at most `max_rows` rows each,
    drawn evenly.

    Groups of as many rows keep the same ones.
    """
    chosen = np.unique(
        np.linspace(0, len(groups) - 1, min(max_groups, len(groups))).round().astype(int)
    )
    return tuple(groups[number].thin_rows(max_rows) for number in chosen)
