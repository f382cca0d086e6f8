"""`gsparc place ckpt=FILE`: where one more station serves an area best."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from gsparc.apps.maps import placing
from gsparc.apps.maps.pictures import draw_placement
from gsparc.apps.maps.promised import read_or_gather, reopen_training
from gsparc.commands.shared.output import finish_run, run_directory
from gsparc.commands.shared.settings import RunSettings, to_dict
from gsparc.evaluation.summary import coordinates, write_samples
from gsparc.models import checkpoint
from gsparc.models.per_station import UNHEARD
from gsparc.prediction.operating_point import load


def task(config: DictConfig) -> dict[str, Any]:
    """Try candidates, draw and write; returns the facts of `summary.json`."""
    RunSettings.from_config(config)
    run_dir, settings, path = run_directory(), to_dict(config), str(config.ckpt)
    stored = checkpoint.read(path)
    if str(UNHEARD) not in stored.state.get("per_station", {str(UNHEARD): None}):
        raise placing.unheard_stations_error(path)  # before the copies of all stations are restored
    predictor = load(path)
    query = {
        "area": settings["area"], "threshold_db": float(config.threshold_db),
        "height_m": config.height_m, "sites": config.sites, "station_height_m": config.station_height_m,
        "antenna": placing.Antenna(**settings["antenna"]),
    }  # fmt: skip
    placing.place_station(predictor, count=1, dry=True, **query)  # refuses before anything is fitted
    promise, error = read_or_gather(path, settings), placing.NewStationError()
    # Stations left out one by one tell how far the level of a new one is off.
    if config.left_out:
        error = placing.new_station_error(reopen_training(path, settings["dataset"]), int(config.left_out))
    found = placing.place_station(predictor, count=config.count, promise=promise, error=error, **query)
    columns = {**found.given, **coordinates(found.places, predictor)}
    columns |= {"coverage": found.coverage, "low": found.low, "high": found.high}
    write_samples(run_dir / "place.csv", {name: values.tolist() for name, values in columns.items()})
    level, unit = float(config.threshold_db), predictor.site.level_unit
    draw_placement(found, run_dir / "place.png", level, unit)
    # Candidates come best first.
    x, y, z = found.places[0]
    where = f"({x:.2f}, {y:.2f}, {z:.2f})"
    if predictor.site.georeference is not None:
        latitude, longitude, _ = predictor.degrees(found.places[0])
        where = f"{latitude:.6f}, {longitude:.6f} degrees, {z:.4g} m high"
    facts = {
        "place/x": x, "place/y": y, "place/z": z, "place/before": found.before,
        "place/after": found.coverage[0], "place/low": found.low[0], "place/high": found.high[0],
        "place/refused": found.refused, "place/candidates": len(found.places), "place/threshold_db": level,
        "place/offset_db": error.offset_db, "place/left_out": error.stations, "ckpt": path,
    }  # fmt: skip
    lines = [
        placing.assumption(predictor.site, z, query["antenna"]),
        f"now {found.before:.1%} of the area with {level:g} {unit} or more"
        + (f"; {found.refused:.0%} of it was never tested, and is left out here" if found.refused else ""),
        f"with a station at {where}: {found.coverage[0]:.1%} "
        f"(90 % interval {found.low[0]:.1%} to {found.high[0]:.1%}), a gain of "
        f"{found.coverage[0] - found.before:.1%} ({found.low[0] - found.before:.1%} to "
        f"{found.high[0] - found.before:.1%})",
    ]
    if error.stations:
        lines[-1] += f", which counts how far {error.stations} stations left out were off as a whole"
    else:
        lines.append("the interval knows nothing of a whole station's offset: no station was left out")
    return finish_run(run_dir, facts, lines=lines, before=f"{len(found.places)} candidates; ")
