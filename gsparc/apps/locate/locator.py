"""Where snapshots were heard, by the likelihood of a trained field."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any

import numpy as np
import torch

from gsparc.apps.locate.calibration import calibrate_level, calibrate_trust
from gsparc.apps.locate.cells import Cells, beyond_box
from gsparc.apps.locate.likelihood import Trust
from gsparc.apps.locate.posterior import Posterior, densest_cells
from gsparc.apps.locate.search import Nuisances, Search, compute_misfit
from gsparc.apps.locate.site_field import Moments, SiteField
from gsparc.apps.locate.snapshots import Snapshots, group_snapshots
from gsparc.data.executor import run_all, run_each
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.refit import Learned

log = logging.getLogger(__name__)

MOST = 3_000  # cells of the coarse grid
COUNTS = (50, 100, 200)  # snapshots that trust is learned from: more where radii of areas are not known ...
KNOWN = 0.1  # ... to this share of them
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
        doubt: why its area promises nothing: it lies beyond the places that were learned from, or the
            snapshot fits no place; empty: neither.
        inside: 1 where the true place lies in that area, else 0; None where it is unknown.
    """

    place: np.ndarray
    area: float
    modes: int
    posterior: Posterior
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
        share: of places that an area holds.
    """

    field: SiteField
    cells: Cells
    wider: Cells
    unknown: Nuisances
    trust: Trust
    share: float = 0.9

    @cached_property
    def _coarse(self) -> Moments:
        """Computed once: most of the time of the first snapshot."""
        return self.field.moments_at(torch.from_numpy(self.cells.centre))

    @cached_property
    def _further(self) -> Locator:
        """Of the larger box; one, as what it says of its coarse grid takes as long."""
        return replace(self, cells=self.wider)

    def search_cells(self, heard: Snapshots, trust: Trust, before: Search | None = None) -> Search:
        """One snapshot's misfit at cells that are halved as long as few of them hold the mass.

        `before`: the same under another trust, whose cells are halved further.
        """
        current = before or Search(self.cells, compute_misfit(heard, self._coarse, self.unknown))
        for _ in range(LEVELS):
            cells = current.cells
            likely = densest_cells(current.log_density(trust), cells.volume, KEPT)
            wide = cells.edge[likely].max(1)
            likely, wide = likely[wide > trust.spread], wide[wide > trust.spread]
            if not len(likely) or (len(likely) >= ENOUGH and wide.max() < 1.01 * wide.min()):
                break
            chosen = likely[wide >= 0.75 * wide[:HALVED].max()][:HALVED]
            finer = cells.subset(chosen).halve()
            more = compute_misfit(heard, self.field.moments_at(torch.from_numpy(finer.centre)), self.unknown)
            rest = np.setdiff1d(np.arange(len(cells)), chosen)
            others = current.misfit.subset(torch.from_numpy(rest))
            current = Search(cells.subset(rest).join(finer), others + more)
        return current

    def locate(self, heard: Snapshots) -> Iterator[Located]:
        """Yield where each of n snapshots was heard."""
        self._coarse  # noqa: B018 (not on the first snapshot's bill)
        box = self.cells.box()

        def one(number: int) -> Located:
            started, one, doubt = time.perf_counter(), heard.subset(np.array([number])), ""
            search = self.search_cells(one, self.trust)
            unlike = search.least_misfit(self.trust) > self.trust.worst
            volume = search.cells.volume
            likely = search.cells.subset(densest_cells(search.log_density(self.trust), volume, KEPT))
            # What may be as likely beyond the edge touches it; 1 % for rounding.
            if unlike or beyond_box(likely.centre, box, 0.51 * likely.edge).any():
                doubt = DOUBTS["unlike"] * unlike
                wide = self._further.search_cells(one, self.trust)
                if beyond_box(wide.posterior(self.trust).peak()[None], box)[0]:
                    search, doubt = wide, DOUBTS["beyond"]
            posterior, mass = search.posterior(self.trust), self.trust.level
            known = posterior.peak(), posterior.area(mass), posterior.count_modes(mass), posterior
            seconds, true = time.perf_counter() - started, heard.place[number]
            inside = int(posterior.mass_above(true) <= mass) if np.isfinite(true).all() else None
            return Located(*known, seconds, doubt, inside)

        yield from (found for _, found in run_each(one, range(len(heard)), "snapshots"))


def learn_trust(
    learned: Learned, locator: Locator, folds: int, cells: Callable[[np.ndarray], Cells]
) -> tuple[Trust, int]:
    """Return how far such a method is trusted, from training places that it left out, and their number.

    The method is trained again without each of a few groups (`folds`) of its training rows, cut as the test
    rows were; `locator` is that of the whole method, `cells` lays its
    cells by trained places (n, 3) [m, local].
    """
    pairs: list[tuple[Locator, Snapshots]] = []
    data, seed = learned.data, learned.context.seed
    rng = np.random.default_rng(seed)
    inner_folds = learned.cut_folds(folds, seed).folds
    for number, inner in enumerate(inner_folds):
        log.info("calibration %d of %d: without %d rows", number + 1, len(inner_folds), len(inner.test))
        method = learned.refit(inner, learned.context.for_part(f"group{number}"))
        field, trained = SiteField(Predictor(method, data.site)), np.union1d(inner.train, inner.val)
        without = replace(locator, field=field, cells=cells(data.moving[trained][:, :3]))
        heard = group_snapshots(data, inner.test)
        sample = rng.permutation(len(heard))[: -(-COUNTS[-1] // folds)]
        pairs += [(without, heard.subset(np.array([row]))) for row in sample]
    pairs = [pairs[number] for number in rng.permutation(len(pairs))]
    places = np.concatenate([heard.place for _, heard in pairs])
    searched, trust = list[Search](), locator.trust

    def search(count: int) -> list[Search]:
        pieces = [*zip_longest(pairs[:count], searched)]
        what = f"snapshots that were left out{', again' * (len(searched) == len(pieces))}"
        return run_all(lambda piece: piece[0][0].search_cells(piece[0][1], trust, piece[1]), pieces, what)

    for count in COUNTS:
        searched = search(count)
        trust = calibrate_trust(searched, places[:count], locator.share, trust)
        # Which cells are halved depends on the trust: the level is one of cells as they will be.
        searched = search(count)
        trust, radius = calibrate_level(trust, searched, places[:count], locator.share)
        said = "calibrated on %d snapshots left out: areas of %.1f %%, their radius known to %.0f %%"
        log.info(said, len(searched), 100 * trust.level, 100 * radius)
        if radius < KNOWN or count >= len(pairs):
            break
    return trust, len(searched)


def trust_state(trust: Trust, unknown: Nuisances, share: float, **learned: Any) -> dict[str, Any]:
    """Return what `restore_trust` reads again, for a checkpoint's `extra`, with how it was learned."""
    return {KEY: {"trust": asdict(trust), "unknown": asdict(unknown), "share": share, **learned}}


def restore_trust(extra: Mapping[str, Any], unknown: Nuisances, share: float) -> Trust:
    """Return the trust that `trust_state` held.

    Where nothing was, a tenth of the values counts as independent (see `Trust`), which is logged.

    Raises:
        ValueError: it was learned for other settings.
    """
    stored = extra.get(KEY)
    if stored is None:
        log.warning("locate: not calibrated: areas may be several times too large; gsparc locate calibrates")
        return Trust(level=share)
    before, promised = Nuisances(**stored["unknown"]), stored["share"]
    if (before, promised) != (unknown, share):
        settings = f"share={promised}, phase_known={before.phase_known}, offset_db={before.offset_db}"
        raise ValueError(
            f"the model was calibrated with {settings}: `gsparc locate` calibrates it for other settings"
        )
    return Trust(**stored["trust"])


def to_world(located: Located, origin: np.ndarray) -> Located:
    """Return the same with places in the world's coordinates."""
    cells = replace(located.posterior.cells, centre=located.posterior.cells.centre + origin)
    posterior = replace(located.posterior, cells=cells)
    return replace(located, place=located.place + origin, posterior=posterior)
