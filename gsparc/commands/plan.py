"""`gsparc plan ckpt=FILE`: where to measure next."""

from __future__ import annotations

import numpy as np

from gsparc.apps.maps.area import read_plan_settings
from gsparc.apps.maps.geojson import read_outlines, write_way
from gsparc.apps.maps.pictures import draw_measurement_plan
from gsparc.apps.maps.planning import plan_measurements
from gsparc.apps.maps.promise import read_or_gather
from gsparc.commands.map import stations_of
from gsparc.evaluation.summary import coordinates
from gsparc.runs.open_runs import open_run
from gsparc.runs.output import CommandCall, Result, command


@command()
def task(call: CommandCall) -> Result:
    """Choose, draw and write."""
    config, stations, floor = (
        call.config,
        stations_of(call.given["stations"]),
        read_plan_settings(call.given),
    )
    # Before anything is measured there is no model, and places are spread over the area.
    run = None if config.ckpt is None else open_run(config.ckpt, call.given["dataset"])
    predictor = None if run is None else run.predictor
    promise = None if run is None else read_or_gather(run, call.given)
    plan = plan_measurements(
        predictor,
        config.count,
        call.given["area"],
        height_m=config.height_m,
        walkable=config.walkable,
        plan=floor,
        stations=stations,
        other_end=call.given["other_end"],
        promise=promise,
        least_gain_db=float(config.least_gain_db),
        route=config.route,
        start=call.given["start"],
        route_m=config.route_m,
        length_m=config.length_m,
        goal=config.goal,
        threshold_db=call.given["threshold_db"],
    )
    columns = {"order": np.arange(1, len(plan.places) + 1), **coordinates(plan.places, predictor)}
    # Rows are in the order of the walk; the rank is that of their gains.
    columns |= {"rank": plan.chosen + 1, "expected_error_db": plan.expected_db.round(4)}
    if len(plan.path):
        columns["way_m"] = plan.metres.round(1)
        corners = coordinates(np.pad(plan.path, ((0, 0), (0, 1))), predictor)
        write_way(call.folder / "plan.geojson", columns, corners)
    behind = read_outlines(call.given, plan.grid.origin)
    draw_measurement_plan(plan, call.folder / "plan.png", promise, predictor, floor, behind)
    facts = {
        "plan/places": len(plan.places),
        "plan/expected_error_db": plan.after_db,
        "plan/expected_error_before_db": plan.before_db,
        "plan/length_m": plan.length_m,
        "plan/stopped": plan.stopped or None,
        "plan/scatter_db": plan.scatter_db,
        "plan/in_vain": int(bool(plan.in_vain)),
        "plan/promised": int(promise is not None),
        "ckpt": config.ckpt,
    }
    before = (
        f"{len(plan.places)} places: expected error {plan.before_db:.2f} -> {plan.after_db:.2f} dB"
    )
    if predictor is not None and predictor.site.stations is not None:
        alike = config.goal == "all" and config.threshold_db is None
        judged = (
            ("all stations alike (a map shows the strongest)") if alike else "the strongest station"
        )
        judged = judged if stations is None else ", ".join(map(str, stations))
        doubt = (
            "" if config.threshold_db is None else (f", where {config.threshold_db:g} is in doubt")
        )
        before += f" of {judged}{doubt}"
        if promise is not None and (each := promise.stations_of_place()) < len(
            predictor.site.stations
        ):
            before += f", if a place lists the {each} strongest of {len(predictor.site.stations)}"
    kind = (
        "straight from place to place"
        if config.walkable is None
        else ("along the lines of walkable")
    )
    way_line = f"a way of {plan.length_m:.0f} m, {kind}; rows logged on the way do not count"
    lines = filter(None, (plan.stopped, plan.in_vain, way_line))
    return Result(facts, (), lines, f"{before}; plan ", {"plan.csv": columns})
