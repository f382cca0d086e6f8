"""What a published map claims, square by square, and its errors as a process over places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import ndtr

from gsparc.apps.maps.area import Grid, bounds_and_inside_test, lay_grid
from gsparc.apps.maps.geojson import is_drawn, middle_of
from gsparc.base.errors import DataError, list_first
from gsparc.data.georeference import Georeference
from gsparc.data.target import MOST_DB
from gsparc.datasets.prior_levels import settings_of
from gsparc.datasets.rasters import BAND, LOCAL, read_raster
from gsparc.processes.few_rows import covering_rows
from gsparc.processes.level_field import fit_level_field
from gsparc.processes.posterior import Exact
from gsparc.processes.prior import Prior
from gsparc.processes.uncertainty import central_interval

MOST_SQUARES = 250_000  # of a claim: finer ones are taken together
LEARNED_ON, SAMPLED = 600, 600  # rows, and places that a share is drawn over
DRAWS, BLOCK = 1000, 4096
# Of the variance of errors, that a region beyond a drive shares: of 120 intervals from 100 rows of
# two towns as they were walked 109 held the share with it, 85 without
REGION = 0.1


@dataclass(frozen=True)
class Claim:
    """Places that something is claimed of.

    Attributes:
        place: (M, 2) [m] about the origin.
        level: (M,) [dB] that is claimed; NaN of a claim of yes.
        grid: squares of the whole claim, of which those claimed are inside.
        digest: of its file, 16 hexadecimal digits.
    """

    place: np.ndarray
    level: np.ndarray
    grid: Grid
    digest: str

    def coordinates(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns of places (n, 2) [m], in degrees, too, where they are known."""
        columns = dict(zip(("x", "y"), places.T.round(2), strict=True))
        if self.grid.origin is not None:
            latitude, longitude = self.grid.origin.to_degrees(places)
            columns |= {"latitude": latitude.round(7), "longitude": longitude.round(7)}
        return columns

    def local(self, places: np.ndarray, about: Georeference | None, where: str) -> np.ndarray:
        """Return places (n, 2) [m] about another origin in the claim's metres.

        Raises:
            DataError: one of both has a place on Earth, and the other none.
        """
        own = self.grid.origin
        if own is None and about is None:
            return places
        if own is None or about is None:
            lack, have = ("rows", "claim") if about is None else ("claim", "rows")
            raise DataError(
                f"{where}: the {have} has a place on Earth, the {lack} none; say the projection of "
                "the claim, claim={file: FILE, crs: 'EPSG:32617'}, or give degrees of the rows"
            )
        return own.from_degrees(*about.to_degrees(places))

    def nearest(self, places: np.ndarray, reach: float = np.inf) -> np.ndarray:
        """Return the number (n,) of the claimed place nearest to each of (n, 2) [m]; -1: beyond."""
        away, number = cKDTree(self.place).query(places)
        return np.where(away <= reach, number, -1)


def read_claim(
    claim: Any,
    threshold_db: float | None = None,
    station: str | None = None,
    area: Any = None,
    step_m: float | None = None,
) -> Claim:
    """Read a claim, of the squares that it calls served.

    Args:
        claim: raster of levels, or of 1 (yes) and 0; polygons of yes, as `read_shapes` takes them;
            `{file: FILE, crs: ..., nodata: ..., legend: ...}` where a file does not state these.
        threshold_db: from which level on a place is called served; None: all levels are claimed.
        station: whose band is audited; None: that of the best server, or the only one.
        area: polygons of what is audited; None: all of it.
        step_m: side of a square [m]; None: that of the raster, of polygons so many as maps have.

    Raises:
        DataError: no such file, projection or band; nothing claimed.
    """
    given = settings_of(claim, "claim")
    name = given.pop("file", claim)
    path = Path(str(name))
    if not is_drawn(name) and not path.is_file():
        raise DataError(f"claim={name}: no such file; a raster or polygons are needed")
    if is_drawn(name):
        origin = None if given.get("crs") == LOCAL else middle_of(name, "claim")
        grid = lay_grid(None, name, step_m=step_m, origin=origin)
        level = grid.inside.ravel() * 1.0
    else:
        grid, level = _read_squares(path, given, station, step_m)
    places, inside = grid.places(np.arange(grid.inside.size)), grid.inside.ravel()
    if area is not None:
        inside = inside & bounds_and_inside_test(grid.origin, area, "area", float(np.ptp(places)))[
            1
        ](places)
    level = np.where(inside & (np.abs(level) <= MOST_DB), level, np.nan)
    if not np.isfinite(level).any():
        raise DataError(f"claim={name}: no level is known in the area")
    yes = bool(np.isin(level[np.isfinite(level)], (0, 1)).all())
    least = 1.0 if yes else -np.inf if threshold_db is None else threshold_db
    claimed = level >= least
    if not claimed.any():
        ends = f"{np.nanmin(level):g} to {np.nanmax(level):g}"
        raise DataError(f"claim={name}: no place reaches {least:g}, its levels are {ends}")
    content = path.read_bytes() if path.is_file() else str(name).encode()
    grid = replace(grid, inside=claimed.reshape(grid.inside.shape))
    told = np.where(yes, np.nan, level[claimed])
    return Claim(places[claimed, :2], told, grid, sha256(content).hexdigest()[:16])


def _read_squares(
    path: Path, given: Mapping[str, Any], station: str | None, step_m: float | None
) -> tuple[Grid, np.ndarray]:
    """Squares of one size over a raster, and levels (ny nx,) [dB] of those nearest to them."""
    raster = read_raster(path, **given)
    origin, names = raster.middle(path), list(raster.names)
    band = f"{BAND} {station}" if f"{BAND} {station}" in names else station or BAND
    if band not in names and (station or len(names) > 1):
        named = list_first([name or f"{k}" for k, name in enumerate(names, 1)])
        raise DataError(f"claim={path}: no band {band} among {named}; say station=NAME")
    kept = [names.index(band) if band in names else 0]
    alone = replace(raster, names=("",), units=(raster.units[kept[0]],), bands=raster.bands[kept])
    _, at, level = next(alone.levels(path, origin, key="claim"))
    # Squares of degrees are no squares of metres
    width = int(np.argmax(raster.points[:, 1] != raster.points[0, 1])) or 1
    sides = np.linalg.norm(at[[1, width]] - at[0], axis=1) if len(at) > 1 else np.ones(2)
    low, high = at.min(0) - sides / 2, at.max(0) + sides / 2
    side = step_m or max(float(np.sqrt(sides.prod())), np.sqrt((high - low).prod() / MOST_SQUARES))
    grid = lay_grid(None, [*low, *high], step_m=float(side), origin=origin)
    away, number = cKDTree(at).query(grid.places()[:, :2])
    return grid, np.where(away <= 0.51 * np.hypot(*sides), level[number], np.nan)


@dataclass(frozen=True)
class ClaimErrors:
    """Claimed less measured levels, given rows: where a claim is in doubt, what share of it holds.

    All of it depends on the process being right; no verdict comes from it.

    Attributes:
        posterior: of the errors about their mean, in units of the kernel's amplitude.
        mean, mean_variance: of all errors [dB, dB^2].
    """

    posterior: Exact
    mean: float
    mean_variance: float

    @classmethod
    def from_rows(cls, place: np.ndarray, error: np.ndarray) -> ClaimErrors:
        """Learn from errors (n,) [dB] at places (n, 2) [m]."""
        rows = covering_rows(place, LEARNED_ON, 0)
        at, value = place[rows], error[rows]
        field = fit_level_field(at, value, np.zeros(len(at)))
        sums = field.precision(at).sum(0)
        mean = float(sums @ value / sums.sum())
        values = torch.from_numpy(value - mean)[:, None]
        posterior = Exact.from_values(Prior(field.kernel), torch.from_numpy(at), values)
        return cls(posterior, mean, float(1 / sums.sum()) + REGION * field.kernel.amplitude)

    def chance_below(self, place: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Return how likely measured levels at places (n, 2) are lower than claimed by more than
        margins (n,) [dB].
        """
        answers = [self.posterior.answer(block) for block in torch.from_numpy(place).split(BLOCK)]
        mean, variance = (torch.cat(parts).numpy() for parts in zip(*answers, strict=True))
        spread = np.sqrt(self.posterior.prior.kernel.amplitude * variance + self.mean_variance)
        return np.asarray(ndtr((mean[:, 0] + self.mean - margin) / spread))

    def share(
        self, place: np.ndarray, margin: np.ndarray, level: float = 0.9
    ) -> tuple[float, float, float]:
        """Return the share of places (n, 2) that hold, and the ends of its interval.

        A place holds where its level is not lower than claimed by more than a margin (n,) [dB].
        """
        random = np.random.default_rng(0)
        some = random.permutation(len(place))[:SAMPLED]
        at, kernel = torch.from_numpy(place[some]), self.posterior.prior.kernel
        middle = self.posterior.answer(at).mean[:, 0].numpy() + self.mean - margin[some]
        covariance = self.posterior.covariance(at).numpy() + self.mean_variance
        error = random.multivariate_normal(middle, covariance, DRAWS, "ignore", method="eigh")
        held = ndtr(-error / max(np.sqrt(kernel.noise * kernel.amplitude), 1e-9)).mean(1)
        return float(held.mean()), *central_interval(held, level)
