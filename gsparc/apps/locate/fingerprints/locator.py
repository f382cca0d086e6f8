"""Where fingerprints were heard, with an area that holds the place in a promised share of cases."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch

from gsparc.apps.locate.calibration import calibrated
from gsparc.apps.locate.cells import Cells, cover_floors
from gsparc.apps.locate.fingerprints.field import FingerprintField, Levels, learn, misfit
from gsparc.apps.locate.likelihood import Trust
from gsparc.apps.locate.locator import HELD_OUT, Located
from gsparc.apps.locate.posterior import Posterior
from gsparc.apps.locate.search import Looked
from gsparc.apps.locate.snapshots import Snapshots
from gsparc.apps.locate.track import as_looked, smoothed, speed
from gsparc.data.datasets.fingerprints import Fingerprints, How, parted

ROWS = 64  # at a time
PLAIN = Trust(1.0, 1.0, 100.0)  # the field's own variances, and nothing else
SHARED = Trust(1.0, 0.3, 100.0)  # access points of one row err together


@dataclass(frozen=True)
class FingerprintLocator:
    """A field of fingerprints with the places where one can stand.

    Attributes:
        field: what would be heard.
        cells: see `cover_floors`; `around` is whether they are near trained places alone.
        levels: expected at the cells.
        offset_db: deviation of what a device adds to all levels [dB].
        speed: of walks [m/s], whose rows are located together; None: each row on its own.
        point: trust whose mean is the place.
        area: trust of areas.
    """

    field: FingerprintField
    cells: Cells
    levels: Levels
    around: bool
    offset_db: float
    speed: float | None
    point: Trust = SHARED
    area: Trust = SHARED

    @classmethod
    def of(
        cls, rows: Fingerprints, offset_db: float, around: bool, track: bool,
        like: FingerprintField | None = None,
    ) -> Self:  # fmt: skip
        """Learned from rows of known places, with the kernel of another field where one is given."""
        field, cells = learn(rows.level, rows.position, like=like), cover_floors(rows.position, around)
        pace = speed(rows.position, rows.time_s, rows.walk) if track else None
        return cls(field, cells, field.moments(torch.from_numpy(cells.centre)), around, offset_db, pace)

    def look(self, rows: Fingerprints) -> Iterator[Looked]:
        """Return the misfit of each row at all cells, or what its whole walk says."""
        single = (
            Looked(self.cells, misfits.of(number))
            for level in torch.from_numpy(rows.level).split(ROWS)
            for misfits in [misfit(level, self.levels, self.offset_db, self.field.sensitivity)]
            for number in range(len(level))
        )
        if self.speed is None:
            yield from single
            return
        posteriors = [one.by(SHARED) for one in single]
        for walk in np.unique(rows.walk):
            members = np.flatnonzero(rows.walk == walk)
            steps = smoothed([posteriors[row] for row in members], rows.time_s[members], self.speed)
            for row, step in zip(members, steps, strict=True):
                posteriors[row] = step
        yield from map(as_looked, posteriors)

    def locate(self, rows: Fingerprints) -> list[Located]:
        """Each row."""
        start = time.perf_counter()
        results = [
            Located.of(one.by(self.area), self.area.level, place(one.by(self.point)))
            for one in self.look(rows)
        ]
        each = (time.perf_counter() - start) / max(len(results), 1)
        return [replace(one, seconds=each) for one in results]


def place(posterior: Posterior) -> np.ndarray:
    """Return the mean (3,) [m] of the floor that has most mass, which errs less than the likeliest cell."""
    mass, centre = posterior.mass, posterior.cells.centre
    floor = np.unique(centre[:, 2], return_inverse=True)[1].reshape(-1)
    there = floor == np.bincount(floor, mass).argmax()
    return mass[there] @ centre[there] / mass[there].sum()


def trusted(
    locator: FingerprintLocator, rows: Fingerprints, how: How, side_m: float, held_out: float, groups: int,
    share: float, seed: int,
) -> tuple[FingerprintLocator, int]:  # fmt: skip
    """Return the same with trusts of rows that were left out, and the number of these.

    The field is learned again, with its kernel, without each of a few `groups` of rows, drawn like test rows
    (`how`, `side_m`, `held_out`: see `parted`). Areas are calibrated on them to hold a `share` of places; of
    three trusts that one makes the places whose mean error is least.
    """
    misfits: list[Looked] = []
    true, track = [], locator.speed is not None
    for number in range(groups):
        train, test = parted(rows, how, side_m, held_out, seed + 1 + number)
        without = FingerprintLocator.of(
            rows.at(train), locator.offset_db, locator.around, track, locator.field
        )
        picks = np.random.default_rng(seed).permutation(len(test))[: -(-HELD_OUT // groups)]
        looks = list(without.look(rows.at(test if track else test[picks])))  # a walk is one
        misfits += [looks[row] for row in picks] if track else looks
        true.append(rows.position[test[picks]])
    places = np.concatenate(true)

    def error(trust: Trust) -> float:
        return float(np.linalg.norm([place(one.by(trust)) for one in misfits] - places, axis=1).mean())

    area = calibrated(misfits, places, share, SHARED, blurred=False)
    return replace(locator, point=min((SHARED, PLAIN, area), key=error), area=area), len(places)


def as_snapshots(rows: Fingerprints) -> Snapshots:
    """Return what plain methods learn from."""
    values = torch.from_numpy(rows.level).double()
    return Snapshots("rssi", values, None, rows.position, np.arange(len(values)))
