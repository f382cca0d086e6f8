"""`gsparc place ckpt=FILE`: where one more station serves an area best."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from gsparc.apps.maps.pictures import draw_placing
from gsparc.apps.maps.placing import (
    Antenna,
    NewStation,
    new_station_error,
    place_next,
    unheard_stations_error,
)
from gsparc.apps.maps.promised import promise_of, trained
from gsparc.commands.shared.output import coordinates, finish_run, run_directory
from gsparc.commands.shared.settings import RunSettings, plain
from gsparc.evaluation.summary import write_samples
from gsparc.models import checkpoint
from gsparc.models.per_station import UNHEARD
from gsparc.prediction.operating_point import load


def task(config: DictConfig) -> dict[str, Any]:
    """Try candidates, draw and write; returns the facts of `summary.json`."""
    RunSettings.of(config)
    run_dir, settings, path = run_directory(), plain(config), str(config.ckpt)
    stored = checkpoint.read(path)
    if str(UNHEARD) not in stored.state.get("per_station", {str(UNHEARD): None}):
        raise unheard_stations_error(path)  # before the copies of all stations are restored
    predictor = load(path)
    query = {
        "area": settings["area"], "threshold_db": float(config.threshold_db),
        "height_m": config.height_m, "sites": config.sites, "station_height_m": config.station_height_m,
        "antenna": Antenna(**settings["antenna"]),
    }  # fmt: skip
    place_next(predictor, count=1, dry=True, **query)  # refuses what cannot be before anything is fitted
    promise, error = promise_of(path, settings), NewStation()
    # Stations left out one by one tell how far the level of a new one is off.
    if config.left_out:
        error = new_station_error(trained(path, settings["dataset"]), int(config.left_out))
    placing = place_next(predictor, count=config.count, promise=promise, error=error, **query)
    columns = coordinates(placing.places, predictor)
    columns |= {"coverage": placing.coverage, "low": placing.low, "high": placing.high}
    write_samples(run_dir / "place.csv", {name: values.tolist() for name, values in columns.items()})
    level, unit = float(config.threshold_db), predictor.site.level_unit
    draw_placing(placing, run_dir / "place.png", level, unit)
    # Candidates come best first.
    x, y, z = placing.places[0]
    where = f"({x:.2f}, {y:.2f}, {z:.2f})"
    if predictor.site.georeference is not None:
        latitude, longitude, _ = predictor.degrees(placing.places[0])
        where = f"{latitude:.6f}, {longitude:.6f} degrees, {z:.4g} m high"
    facts = {
        "place/x": x, "place/y": y, "place/z": z, "place/before": placing.before,
        "place/after": placing.coverage[0], "place/low": placing.low[0], "place/high": placing.high[0],
        "place/candidates": len(placing.places), "place/threshold_db": level,
        "place/offset_db": error.offset_db, "place/left_out": error.stations, "ckpt": path,
    }  # fmt: skip
    lines = [
        f"assumed: {z:.4g} m high, {query['antenna']} (see station_height_m, antenna)",
        f"now {placing.before:.1%} of the area with {level:g} {unit} or more",
        f"with a station at {where}: {placing.coverage[0]:.1%} "
        f"(90 % interval {placing.low[0]:.1%} to {placing.high[0]:.1%})",
    ]
    if not error.stations:
        lines.append("the interval knows nothing of a whole station's offset: no station was left out")
    return finish_run(run_dir, facts, lines=lines, before=f"{len(placing.places)} candidates; ")
