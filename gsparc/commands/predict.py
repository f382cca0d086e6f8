"""`gsparc predict ckpt=FILE places=FILE`: predictions at places in degrees or metres, as a table."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from gsparc.commands.shared.output import finish, run_directory
from gsparc.commands.shared.settings import RunSettings, plain
from gsparc.evaluation.answers import predict
from gsparc.prediction.operating_point import load


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    RunSettings.of(config)
    predictor = load(config.ckpt, confidence=config.confidence)
    facts = predict(
        predictor,
        config.places,
        config.out,
        station=None if config.station is None else str(config.station),
        columns=plain(config.columns),
        overwrite=bool(config.overwrite),
    )
    before, stations = f"{facts['predict/places']} places", facts["predict/stations"]
    if stations:
        before += f", {stations} station{'s' * (stations > 1)}"
    if "predict/lowest_db" in facts:
        low, high = facts["predict/lowest_db"], facts["predict/highest_db"]
        before += f": {low:.1f} to {high:.1f} {predictor.site.level_unit}"
    before += f"; predictions in {facts['out']}; summary "
    return finish(run_directory(), facts | {"ckpt": str(config.ckpt)}, before=before)
