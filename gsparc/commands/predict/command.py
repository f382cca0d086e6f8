"""`gsparc predict ckpt=FILE places=FILE`: predictions at places in degrees or metres, as a table."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from gsparc.commands.output import run_directory, show
from gsparc.commands.predict.answers import answers, check_fits, decibels, target, write
from gsparc.commands.predict.placing import far_outside, in_a_speck, in_world, stations_of, with_heights
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.query_places import QueryPlaces, read_query_places
from gsparc.data.schema import End, Site
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.prediction.operating_point import load
from gsparc.prediction.predictor import Predictor

log = logging.getLogger(__name__)


def predict(
    predictor: Predictor,
    places: str | Path,
    out: str | Path | None = None,
    *,
    station: str | None = None,
    columns: dict[str, object] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Predict at the places of a file and write the answers; what was guessed is logged.

    Args:
        predictor: of the model.
        places: see `read_query_places`.
        out: *.csv or *.npz; None: beside the places.
        station: name or number of the only one to predict.
        columns: of a table of places, by quantity, where a guess will not do.
        overwrite: whether a file that is there may be replaced.

    Returns:
        Facts for `summary.json`.

    Raises:
        DataError: anything that is wrong with the places, the station or the file to write.
    """
    site, places = predictor.site, Path(places)
    path = target(None if out is None else str(out), places, overwrite)
    moving: tuple[End, ...] = ("tx", "rx") if site.static_end is None else (site.moving_end,)
    queries = with_heights(read_query_places(places, moving, columns or {}), site)
    for note in _notes(queries, site):
        log.info("%s: %s", places, note)
    world = in_world(queries, site)
    pairs = stations_of(queries, site, station)
    named = station is not None or queries.station is not None
    far, margin = far_outside(world, site)
    found, left_out = answers(
        predictor, queries, world, pairs, named, lambda shape: check_fits(path, site.kind, shape)
    )
    for line in left_out:
        log.warning(line)
    speck = in_a_speck(queries, world, site)
    if speck is not None:
        log.warning("%s: %s", places, speck)
    if far.any():
        log.warning(
            "%s: %d of %d places lie more than %.3g m outside the box of the training places, the first in "
            "%s: expect little of the predictions there",
            places, int(far.sum()), len(far), margin, queries.rows[int(np.argmax(far))],
        )  # fmt: skip
    write(path, queries, found, site.kind)
    level = decibels(found)[0] if site.kind == "rssi" else np.zeros(0)
    level = level[np.isfinite(level)]
    ends = {"lowest": float(level.min()), "highest": float(level.max())} if len(level) else {}
    return {
        "predict/places": len(queries),
        "predict/predictions": len(found),
        "predict/far_outside": int(far.sum()),
        "predict/stations": 0 if found.station is None else len(np.unique(found.station)),
        "dataset/name": site.name,
        "dataset/kind": site.kind,
        "model/name": predictor.method.name,
        "places": str(places),
        "out": str(path),
        **{f"predict/{name}_db": value for name, value in ends.items()},
    }


def _notes(queries: QueryPlaces, site: Site) -> list[str]:
    notes, origin = list(queries.notes), site.georeference
    if origin is not None and not any(where.degrees for where in queries.ends.values()):
        notes.append(f"metres are east and north of {origin.latitude:g}, {origin.longitude:g} degrees")
    if queries.station is not None and site.stations is None:
        notes.append("not used: stations; the model has none")
    return notes


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    RunSettings.of(config)
    run_dir = run_directory()
    predictor = load(config.ckpt, confidence=config.confidence)
    facts = predict(
        predictor,
        config.places,
        config.out,
        station=None if config.station is None else str(config.station),
        columns=plain(config.columns),
        overwrite=bool(config.overwrite),
    )
    write_summary(run_dir / "summary.json", {**facts, **provenance(), "ckpt": str(config.ckpt)})
    stations = facts["predict/stations"]
    said = f"{facts['predict/places']} places" + (
        f", {stations} station{'s' * (stations > 1)}" if stations else ""
    )
    if "predict/lowest_db" in facts:
        low, high = facts["predict/lowest_db"], facts["predict/highest_db"]
        said += f": {low:.1f} to {high:.1f} {predictor.site.level_unit}"
    show(run_dir, before=f"{said}; predictions in {facts['out']}; summary ")
    return facts
