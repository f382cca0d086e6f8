"""The promise of a map: stored with its model or gathered anew, and what its reader must know."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.intervals import Coverage, cross_validate
from gsparc.apps.maps.promise import Promise, PromiseSettings, gather_promise, read_promise
from gsparc.data.errors import DataError
from gsparc.evaluation.open_runs import check_dataset, open_files
from gsparc.models import checkpoint
from gsparc.prediction.refit import Learned

log = logging.getLogger(__name__)


def read_or_gather(path: str, settings: Mapping[str, Any]) -> Promise | None:
    """Return the evidence stored with a model, or gathered from its training data and then stored.

    Args:
        path: the model's file.
        settings: `promised`, without which there is none; `promise`, `dataset` and `renew` of conf/map.yaml.

    Raises:
        DataError: the training data are gone, or are others.
    """
    how = PromiseSettings(**settings["promise"])
    check_dataset(path, settings["dataset"])
    if not settings["promised"]:
        return None
    stored = checkpoint.read(path)
    promise = None if settings.get("renew") else read_promise(stored.extra)
    # Blocks of another size are other evidence.
    if promise is not None and how.block_m in (None, promise.block_m):
        return promise
    learned = reopen_training(path, settings["dataset"])
    log.info("testing the intervals of maps: fits without blocks of places")
    promise = gather_promise(learned, how)
    cross_validate(promise.evidence, how.share)  # too little evidence is said before anything is stored
    promise.store(path)
    return promise


def reopen_training(path: str, dataset: dict[str, Any]) -> Learned:
    """Return a model with the very data and rows that it was trained on.

    Raises:
        DataError: they are gone, or are others.
    """
    try:
        run = open_files([path], dataset)
        learned = run.retraining()
    except (ValueError, OSError) as error:
        why = f"{error}; held-out blocks need the training data"
        raise DataError(f"{why}: dataset.file=..., or promised=false") from None
    # Rows of other data are no evidence of what this model has not seen.
    if run.learned != 0 or run.foreign is not None:
        raise DataError(f"{path} was trained on {run.foreign}; give its own data, or promised=false")
    return learned


def map_notes(
    field: FieldMap, coverage: Coverage | None, covered: tuple[float, float] | None = None
) -> list[str]:
    """Return what a reader of the map must know; `covered` is of `covered_between`."""
    notes = [*field.notes]
    figures = field.summarise()
    if (unsure := figures["map/server_unsure"]) and len(field.stations) > 1:
        notes.append(f"best_server: in {unsure:.1%} of squares (hatched) it is more likely another, or none")
    if (outage := figures["map/outage"]) is not None:
        level = f"{field.threshold_db:g} {field.unit} or more of some station (the mean of 1 - outage)"
        ends = "" if covered is None else " (90 % interval {:.1%} to {:.1%})".format(*covered)
        left = (field.grid.inside & field.refused).sum() / max(field.grid.inside.sum(), 1)
        only = f" ({left:.0%} of the area is refused, and not among them)" * bool(left)
        notes.append(f"{1 - float(outage):.1%}{ends} of the predicted squares{only} with {level}")
    if field.unit == "dB":
        notes.append("levels are in dB, as the data name no unit: if they are dBm, say unit=dBm")
    if coverage is None:
        own = "they are the model's own deviations, and no place is refused as too far from data"
        return [*notes, f"intervals are not tested: {own}"]
    tested = f"tested on {coverage.rows} heard rows of {coverage.blocks} held-out blocks"
    held = f"{coverage.share:.1%} of these rows held, {coverage.width_db:.1f} dB wide in their mean"
    of_map = f"in the map {figures['map/width_db']:.1f} dB, the strongest's over predicted squares"
    notes.append(f"{field.share:.0%} intervals, {tested}: {held}; {of_map}")
    if figures["map/refused"]:
        squares = f"{figures['map/refused']} of {int(field.grid.inside.sum())} squares"
        notes.append(f"{squares} are refused: too far from what was measured")
    return notes
