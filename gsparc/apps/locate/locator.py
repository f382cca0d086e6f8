"""Where snapshots were heard, by the likelihood of a trained field."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from itertools import zip_longest
from typing import Any

import numpy as np
import torch

from gsparc.apps.locate.posterior import Cells, PlacePosterior, beyond_box, cover_box, densest_cells
from gsparc.apps.locate.search import (
    Nuisances,
    PlaceSearch,
    Trust,
    calibrate_level,
    calibrate_trust,
    compute_misfit,
)
from gsparc.apps.locate.snapshots import (
    HeardMoments,
    Scans,
    SiteField,
    group_snapshots,
    snapshots_of_values,
)
from gsparc.base.executor import run_all, run_each
from gsparc.prediction.left_out import Learned
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import read_places

log = logging.getLogger(__name__)

MOST = 3_000  # cells of the coarse grid
# Snapshots left out, drawn evenly, that trust is learned from, at first and in all:
# so many tell a share of
# 90 % to 3 points.
TRUSTED, HELD_OUT = 30, 100
HALVED = 16  # cells that are halved at a time
KEPT = 0.9  # of the mass: cells beyond it stay as they are
LEVELS = 8  # halvings of a cell
ENOUGH = 32  # cells of one size that hold this mass need not be halved
FURTHER = 0.5  # of its sides, that a larger box reaches beyond the trained places
DOUBTS = {"beyond": "beyond the trained places", "unlike": "unlike all rows that were left out"}
KEY = "locate"  # in a checkpoint's `extra`


@dataclass(frozen=True)
class Located:
    """Where one snapshot was heard.

    Attributes:
        place: (3,) [m, local], the likeliest.
        area: length, area or volume that holds it in the promised share of cases [m, m^2, m^3].
        modes: parts of that area that are apart, each of some mass.
        posterior: masses of cells.
        seconds: that it took.
        doubt: why its area promises nothing: it lies beyond the places that were learned from, or
            the snapshot fits no place; empty: neither.
        inside: 1 where the true place lies in that area, else 0; None where it is unknown.
    """

    place: np.ndarray
    area: float
    modes: int
    posterior: PlacePosterior
    seconds: float
    doubt: str = ""
    inside: int | None = None


@dataclass(frozen=True)
class Locator:
    """A field with the places where one can stand.

    Attributes:
        field: what would be heard.
        cells: of a coarse grid.
        wider: of a larger box, for what is likeliest at the edge of `cells`.
        unknown: what differs by chance between snapshots.
        trust: see there.
    """

    field: SiteField
    cells: Cells
    wider: Cells
    unknown: Nuisances
    trust: Trust

    @cached_property
    def _coarse(self) -> HeardMoments:
        """Computed once: most of the time of the first snapshot."""
        return self.field.moments_at(torch.from_numpy(self.cells.centre))

    @cached_property
    def _further(self) -> Locator:
        """Of the larger box; one, as what it says of its coarse grid takes as long."""
        return replace(self, cells=self.wider)

    def search_cells(
        self, heard: Scans, trust: Trust, before: PlaceSearch | None = None
    ) -> PlaceSearch:
        """Return one snapshot's misfit at cells that are halved as long as few
        of them hold the mass.

        `before`: the same under another trust, whose cells are halved further.
        """
        current = before or PlaceSearch(
            self.cells, compute_misfit(heard, self._coarse, self.unknown)
        )
        for _ in range(LEVELS):
            cells = current.cells
            likely = densest_cells(current.log_density(trust), cells.volume, KEPT)
            wide = cells.edge[likely].max(1)
            likely, wide = likely[wide > trust.spread], wide[wide > trust.spread]
            if not len(likely) or (len(likely) >= ENOUGH and wide.max() < 1.01 * wide.min()):
                break
            chosen = likely[wide >= 0.75 * wide[:HALVED].max()][:HALVED]
            finer = cells.subset(chosen).halve()
            more = compute_misfit(
                heard, self.field.moments_at(torch.from_numpy(finer.centre)), self.unknown
            )
            rest = np.setdiff1d(np.arange(len(cells)), chosen)
            current = PlaceSearch(
                cells.subset(rest).join(finer), current.misfit.subset(rest) + more
            )
        return current

    def locate(self, heard: Scans) -> Iterator[Located]:
        """Yield where each of n snapshots was heard."""
        self._coarse  # noqa: B018 (not on the first snapshot's bill)
        box = self.cells.box()

        def one(number: int) -> Located:
            started, snapshot, doubt = time.perf_counter(), heard.subset(np.array([number])), ""
            search = self.search_cells(snapshot, self.trust)
            unlike = search.least_misfit(self.trust) > self.trust.worst
            volume = search.cells.volume
            likely = search.cells.subset(
                densest_cells(search.log_density(self.trust), volume, KEPT)
            )
            # What may be as likely beyond the edge touches it; 1 % for rounding.
            if unlike or beyond_box(likely.centre, box, 0.51 * likely.edge).any():
                doubt = DOUBTS["unlike"] * unlike
                wide = self._further.search_cells(snapshot, self.trust)
                if beyond_box(wide.posterior(self.trust).peak()[None], box)[0]:
                    search, doubt = wide, DOUBTS["beyond"]
            posterior, mass, volume = (
                search.posterior(self.trust),
                self.trust.level,
                search.cells.volume,
            )
            area = float(volume[densest_cells(posterior.log_density, volume, mass)].sum())
            seconds, true = time.perf_counter() - started, heard.place[number]
            inside = int(posterior.mass_above(true) <= mass) if np.isfinite(true).all() else None
            return Located(
                posterior.peak(),
                area,
                posterior.count_modes(mass),
                posterior,
                seconds,
                doubt,
                inside,
            )

        yield from (answer for _, answer in run_each(one, range(len(heard)), "snapshots"))


def learn_trust(
    learned: Learned,
    locator: Locator,
    share: float,
    folds: int,
    cells: Callable[[np.ndarray], Cells],
) -> tuple[Trust, int]:
    """Return how far such a method is trusted, from training places that it left out,
    and their number.

    The method is trained again without each of a few groups (`folds`) of its training rows, cut as
    the test rows were; `locator` is that of the whole method, `share` that of places which areas
    hold, `cells` lays cells by trained places (n, 3) [m, local].
    """
    pairs: list[tuple[Locator, Scans]] = []
    data, seed = learned.data, learned.context.seed
    inner_folds = learned.cut_folds(folds, seed).folds
    for number, inner in enumerate(inner_folds):
        log.info(
            "calibration %d of %d: without %d rows", number + 1, len(inner_folds), len(inner.test)
        )
        method = learned.refit(inner, learned.context.for_part(f"group{number}"))
        field, trained = SiteField(Predictor(method, data.site)), np.union1d(inner.train, inner.val)
        without = replace(locator, field=field, cells=cells(data.moving[trained][:, :3]))
        heard = group_snapshots(data, inner.test)
        pairs += [(without, heard.subset(np.array([row]))) for row in range(len(heard))]
    pairs = [
        pairs[number] for number in np.random.default_rng(seed).permutation(len(pairs))[:HELD_OUT]
    ]
    places = np.concatenate([heard.place for _, heard in pairs])
    searches, trust = list[PlaceSearch](), locator.trust

    def search(count: int) -> list[PlaceSearch]:
        pieces = [(*pair, before) for pair, before in zip_longest(pairs[:count], searches)]
        return run_all(
            lambda one: one[0].search_cells(one[1], trust, one[2]), pieces, "left-out snapshots"
        )

    # Some first, as the rest is sought faster under a trust that is nearly right.
    for count in (TRUSTED, HELD_OUT):
        searches = search(count)
        trust = calibrate_trust(searches, places[: len(searches)], trust)
    # Which cells are halved depends on the trust: the level is one of cells as they will be.
    trust = calibrate_level(trust, search(HELD_OUT), places, share)
    log.info(
        "calibrated on %d left-out snapshots: areas take %.1f %% of the probability",
        len(places),
        100 * trust.level,
    )
    return trust, len(places)


def find_other_settings(extra: Mapping[str, Any], how: Mapping[str, Any]) -> list[str]:
    """Return `name=value` of settings other than `how` that the trust
    in `extra` was learned for.
    """
    stored = extra.get(KEY, {})
    before = {"share": stored.get("share")} | stored.get("how", {}) | stored.get("unknown", {})
    return [
        f"{name}={before.get(name)}" for name, value in how.items() if before.get(name) != value
    ]


def restore_trust(extra: Mapping[str, Any], how: Mapping[str, Any]) -> Trust:
    """Return the trust that a checkpoint's `extra` holds for settings `how`,
    of which `share` is one.

    Where nothing was, a tenth of the values counts as independent (see `Trust`), which is logged.

    Raises:
        ValueError: it was learned for other settings.
    """
    stored = extra.get(KEY)
    if stored is None:
        log.warning(
            "locate: not calibrated: areas may be several times too large; gsparc locate calibrates"
        )
        return Trust(level=how["share"])
    if other := find_other_settings(extra, how):
        raise ValueError(
            f"the model was calibrated with {', '.join(other)}: `locate calibrate=3` does it anew"
        )
    return Trust(**stored["trust"])


def to_world(located: Located, origin: np.ndarray) -> Located:
    """Return the same with places in the world's coordinates."""
    cells = replace(located.posterior.cells, centre=located.posterior.cells.centre + origin)
    posterior = replace(located.posterior, cells=cells)
    return replace(located, place=located.place + origin, posterior=posterior)


def locate(
    predictor: Predictor,
    values: Any,
    *,
    silent: Any = None,
    where: Any = None,
    phase_known: bool = False,
    offset_db: float = 0.0,
    share: float = 0.9,
    unit: str | None = None,
) -> list[Located]:
    """Find where snapshots were heard, by the likelihood of a model, in world coordinates.

    >>> locate(gsparc.load("city.ckpt"), [[-90.0, -75.2]])[0].place.shape  # (n, stations) [dBm]
    (3,)

    Args:
        predictor: of a model with a variance whose one end alone moves.
        values: (n, ...) spectra, channels or powers; where there are stations (n, stations, ...),
            NaN where one is missing.
        silent: bool like powers, True where the value is the level below which nothing was heard.
        where: (m, 3) world places near which one can stand; None: in the box of the measured ones.
        phase_known: whether channels come in the phase of the trained ones.
        offset_db: standard deviation of an offset that all powers of a snapshot share [dB].
        share: of places that an area is to hold; kept by what `gsparc locate` learned for the same
            settings and stored with the model, else as the model's own variances say.
        unit: of powers; None: as they are answered.

    Raises:
        ValueError: values of another kind or shape, both ends move, or a model without variance.
    """
    site = predictor.site
    if site.target.is_level and not np.iscomplexobj(values):
        # By way of stored units: users give levels in the unit that answers come in.
        stored = site.power_unit(unit or predictor.unit).stored(torch.as_tensor(values))
        values = stored * site.target_scale
    heard = snapshots_of_values(site, values, silent)
    places = (
        None
        if where is None
        else tuple(map(tuple, np.atleast_2d(read_places("where", where)).tolist()))
    )
    answers = _locator(predictor, places, Nuisances(phase_known, offset_db), share).locate(heard)
    return [to_world(answer, site.origin) for answer in answers]


# What a model says of the coarse grid is most of the time of the first snapshot
@lru_cache(maxsize=4)
def _locator(
    predictor: Predictor,
    places: tuple[tuple[float, ...], ...] | None,
    unknown: Nuisances,
    share: float,
) -> Locator:
    """Of world places (m, 3); None: of the box of the measured ones."""
    site = predictor.site
    local = site.moving_box[:, :3] if places is None else np.asarray(places) - site.origin
    trust = restore_trust(predictor.extra, {"share": share, **asdict(unknown)})
    how = predictor.extra.get(KEY, {}).get("how", {})
    before = how.get("prior"), how.get("plan")
    if how and before != ("box" if places is None else "where", None):
        log.warning("locate: areas were calibrated with prior=%s, plan=%s, not here", *before)
    cells, wider = (
        cover_box(local, MOST, places is not None, beyond=beyond) for beyond in (0, FURTHER)
    )
    return Locator(SiteField(predictor), cells, wider, unknown, trust)
