"""`gsparc predict ckpt=FILE places=FILE`: predictions at places in degrees or metres,
as a table.
"""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from gsparc.apps.maps.promise import read_promise
from gsparc.evaluation.answers import predict_file
from gsparc.prediction.operating_point import load
from gsparc.runs.output import begin_run, finish_run


def task(config: DictConfig) -> dict[str, Any]:
    """Predict at places of a table; return the facts written to `summary.json`
    in the run directory.
    """
    run_dir, settings = begin_run(config)
    predictor = load(config.ckpt, confidence=config.confidence, unit=config.unit)
    if config.frequency_hz is not None:
        predictor = predictor.select_carrier(config.frequency_hz)
    station = None if config.station is None else str(config.station)
    promise = read_promise(predictor.extra)
    how: dict[str, Any] = {"columns": settings["columns"], "overwrite": bool(config.overwrite)}
    how["tested"] = None if promise is None else promise.expected_errors
    facts = predict_file(predictor, config.places, config.out, station=station, **how)
    before, stations = f"{facts['predict/places']} places", facts["predict/stations"]
    if stations:
        before += f", {stations} station{'s' * (stations > 1)}"
    # Powers alone have a lowest and a highest.
    ends = [
        value
        for name, value in facts.items()
        if name.startswith(("predict/lowest", "predict/highest"))
    ]
    if ends:
        before += f": {' to '.join(f'{end:.4g}' for end in ends)} {predictor.unit}"
    before += f", {empty} predictions empty" if (empty := facts["predict/empty"]) else ""
    before += f"; predictions in {facts['out']}"
    if promise is None and predictor.site.target.is_level:
        before += (
            "; deviations are the model's own: gsparc map ckpt=FILE tests them, then ask again"
        )
    before += "; summary "
    return finish_run(run_dir, facts | {"ckpt": str(config.ckpt)}, before=before)
