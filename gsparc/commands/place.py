"""`gsparc place ckpt=FILE`: where one more station serves an area best."""

from __future__ import annotations

from math import isnan

from gsparc.apps.maps import placing
from gsparc.apps.maps.pictures import draw_placement
from gsparc.apps.maps.promise import read_or_gather, reopen_training
from gsparc.evaluation.summary import coordinates
from gsparc.models import checkpoint
from gsparc.models.station_sites import UNHEARD
from gsparc.runs.open_runs import open_run
from gsparc.runs.output import CommandCall, Result, command


@command()
def task(call: CommandCall) -> Result:
    """Try candidates, draw and write."""
    config, path = call.config, call.given["ckpt"]
    if str(UNHEARD) not in checkpoint.read(path).state.get("per_station", {str(UNHEARD): None}):
        raise placing.unheard_stations_error(path)  # before the copies of all stations are restored
    run = open_run(path, call.given["dataset"])
    predictor = run.predictor
    where = {
        "area": call.given["area"],
        "height_m": config.height_m,
        "sites": config.sites,
        "count": config.count,
        "station_height_m": config.station_height_m,
        "antenna": placing.NewAntenna(**call.given["antenna"]),
    }
    placing.lay_candidates(predictor, **where)  # refuses before anything is fitted
    promise, error = read_or_gather(run, call.given), placing.NewStationError()
    # Stations left out one by one tell how far the level of a new one is off.
    if config.left_out:
        error = placing.new_station_error(reopen_training(run), int(config.left_out))
    level, unit = float(config.threshold_db), predictor.site.level_unit
    placement = placing.place_station(
        predictor, threshold_db=level, promise=promise, error=error, **where
    )
    columns = {
        **coordinates(placement.places, predictor),
        "coverage": placement.coverage,
        "gain": placement.gain,
        **dict(zip(("low", "high", "gain_low", "gain_high"), placement.between.T, strict=True)),
        "nearest_m": placement.nearest_m,
    }
    draw_placement(placement, call.folder / "place.png", level, unit)
    # Candidates come best first.
    best = {
        name: None if isnan(values[0]) else float(values[0]) for name, values in columns.items()
    }
    at = "({x:.2f}, {y:.2f}, {z:.2f})"
    if predictor.site.georeference is not None:
        at = "{latitude:.6f}, {longitude:.6f} degrees, {z:.4g} m high"
    facts = {f"place/{name}": value for name, value in best.items()} | {
        "place/before": placement.before,
        "place/after": best["coverage"],
        "place/refused": placement.refused,
        "place/candidates": len(placement.places),
        "place/threshold_db": level,
        "place/offset_db": error.offset_db,
        "place/left_out": error.stations,
        "ckpt": path,
    }
    # At a known place
    next_one = "" if best["nearest_m"] is None else ", {nearest_m:.4g} m from the next"
    sentence = "with a station at " + at + next_one + ": {coverage:.1%}, gaining "
    interval = "no interval is known: no station could be left out, or promised=false, left_out=0"
    if best["low"] is not None:
        low, high = placement.between[:, 2:].T
        alike = ((low <= placement.gain[0]) & (placement.gain[0] <= high))[1:].sum()
        interval = "90 % intervals {low:.1%} to {high:.1%}, of the gain " + (
            f"{100 * low[0]:.1f} to "
        )
        interval += f"{100 * high[0]:.1f} points"
        if len(low) > 1:
            interval += f", not significantly above {alike} of {len(low) - 1} others"
    lines = [
        placing.describe_new_station(predictor.site, placement.places[0, 2], where["antenna"]),
        f"now {placement.before:.1%} of the area, {placement.grid.step:.3g} m squares, with "
        f"{level:g} {unit} or more"
        + (
            f"; {placement.refused:.0%} of it was never tested, and is left out here"
            if placement.refused
            else ""
        ),
        sentence.format(**best) + f"{100 * placement.gain[0]:.1f} points",
        interval.format(**best),
    ]
    before, files = (
        f"{len(placement.places)} candidates; ",
        {"place.csv": {**placement.given, **columns}},
    )
    return Result(facts, (), lines, before, files)
