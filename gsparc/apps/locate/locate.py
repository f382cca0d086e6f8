"""Where values in the units and shapes of a model's predictions were heard."""

from __future__ import annotations

import logging
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from gsparc.apps.locate.cells import cover_box
from gsparc.apps.locate.locator import FURTHER, KEY, MOST, Located, Locator, restore_trust, to_world
from gsparc.apps.locate.search import Nuisances
from gsparc.apps.locate.site_field import SiteField
from gsparc.apps.locate.snapshots import snapshots_of_values
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import read_places

log = logging.getLogger(__name__)


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
