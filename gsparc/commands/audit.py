"""`gsparc audit claim=map.tif threshold_dbm=-110 share=0.95`: does a published map hold?"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.special import ndtr

from gsparc.apps.maps import audit, audit_report
from gsparc.apps.maps.claim import Claim, ClaimErrors, read_claim
from gsparc.apps.maps.geojson import read_shapes, write_way
from gsparc.apps.maps.making import MOST_DB
from gsparc.apps.maps.streets import StreetGraph
from gsparc.base.errors import DataError
from gsparc.base.limits import POSITIVE, choice, number, or_null, whole
from gsparc.data.schema import Measurements
from gsparc.datasets.own import read_any
from gsparc.prediction.levels import measured_levels
from gsparc.runs.output import CommandCall, Result, command

log = logging.getLogger(__name__)

LEAST_ROWS = 10  # that a process of errors is learned from


@command(
    threshold_dbm=or_null(number(-MOST_DB, MOST_DB)),
    share=number(0, 1, open_low=True, open_high=True),
    tour=whole(1, 1000),
    tours=whole(0, 1000),
    step_m=or_null(POSITIVE),
    reach_m=or_null(POSITIVE),
    unreached=choice("against", "outside"),
)
def task(call: CommandCall) -> Result:
    """Judge the tours that were driven, draw the next ones, write and draw."""
    given, folder, threshold = call.given, call.folder, call.given["threshold_dbm"]
    demand = audit.Demand(threshold, float(given["share"]), tuple(given["within_db"]))
    claim = read_claim(given["claim"], threshold, given["station"], given["area"], given["step_m"])
    key, drawn = audit.digest_of(claim, demand), given["drawn"]
    draws = None if drawn is None else audit.read_draws(drawn, key, claim)
    facts: dict[str, Any] = {"audit/claim": claim.digest, "audit/key": key, "audit/verdict": "open"}
    lines = [f"claim: {demand.words}; {len(claim.place)} squares of {claim.grid.step:.3g} m"]
    # A claim of levels, or of yes alone, is in doubt everywhere alike before there are rows
    margin = np.nan_to_num(claim.level - (np.nan if threshold is None else threshold))
    chance, before = ndtr(-margin / audit.SPREAD_DB), (np.zeros(0),) * 3
    columns, figures, parts = dict[str, Any](), list[Figure](), list[dict[str, Any]]()
    if given["rows"] is not None:
        data, rows = _read_rows(given, claim)
        claimed, errors = claim.level[claim.nearest(rows.place)], None
        if threshold is not None and len(np.unique(rows.place, axis=0)) >= LEAST_ROWS:
            base = np.nan_to_num(claimed, nan=threshold)
            errors = ClaimErrors.from_rows(rows.place, base - rows.level)
            chance = errors.chance_below(claim.place, margin) + 1e-9
        if draws is not None:
            outside, reach = given["unreached"] == "outside", given["reach_m"] or claim.grid.step
            verdict, count, table = audit.judge(claim, draws, rows, demand, reach, outside)
            columns["capital.csv"] = table
            figures.append(audit_report.draw_capital(table))
            lines += audit_report.describe_verdict(verdict, count, table, outside)
            facts |= {"audit/verdict": verdict, "audit/places": count}
            before = table.weight.to_numpy(), 1 - table.high.to_numpy(), table.ratio.to_numpy()
        else:
            lines.append("nobody drew these rows: no verdict")
            if errors is not None:
                share, low, high = errors.share(claim.place, margin)
                told = f"{share:.1%} hold, 90 % interval {low:.1%} to {high:.1%}"
                lines.append(f"by a model of the rows {told}, if the model is right")
                facts |= {"audit/model": share, "audit/model_low": low, "audit/model_high": high}
        parts, wrong = audit_report.find_errors(data, rows, claimed, folder)
        lines, columns["by_part.csv"] = lines + wrong, pd.DataFrame(parts)
    if given["tours"] and facts["audit/verdict"] == "open":
        ratio = chance / chance.mean()
        draws, told = _draw_next(call, claim, key, draws, ratio, audit.doubt_part(*before, ratio))
        lines = [demand.power(len(draws)), *lines, told]
    columns |= {} if draws is None else {"draws.csv": draws}
    files = {name: given[name] for name in ("rows", "drawn") if given[name] is not None}
    facts |= {f"audit/{name}_digest": audit.digest(file) for name, file in files.items()}
    doubted = {} if threshold is None else {"chance_of_failing": chance}
    audit_report.write_layers(folder / "audit.tif", claim, {"claim_db": claim.level, **doubted})
    note = ", ".join(f"{name.removeprefix('audit/')} {value}" for name, value in facts.items())
    audit_report.write_page(folder, str(given["claim"]), note, lines, parts, figures)
    return Result(facts, (), lines, "audit.html ", columns)


def _read_rows(given: Mapping[str, Any], claim: Claim) -> tuple[Measurements, audit.DriveRows]:
    """Rows of what is audited, in the claim's metres."""
    path, station = f"rows={given['rows']}", given["station"]
    named = {} if station is None else {"stations": [station]}
    settings = {k: v for k, v in given["dataset"].items() if k not in ("file", "name")}
    reading = read_any(given["rows"], **settings | named)
    for note in reading.notes:
        log.info("%s: %s", path, note)
    data = reading.data
    if not data.site.maps_levels or data.site.level_unit not in ("dBm", "dB"):
        raise DataError(f"{path}: in {data.site.level_unit}, of {data.site.kind}; expected dBm")
    level, side = measured_levels(data, np.arange(len(data)))
    place = data.moving[:, -3:-1] + data.site.origin[:2]
    place = claim.local(place, data.site.georeference, path)
    away = claim.nearest(place, 0.75 * claim.grid.step) < 0
    rows = np.flatnonzero(np.isfinite(level) & ~away)
    if not len(rows):
        middle, squares = (np.median(at, axis=0).round() for at in (place, claim.place))
        raise DataError(
            f"{path}: all {len(data)} rows lie outside of what is claimed: about {middle} m, the "
            f"claim about {squares} m"
        )
    log.info("%s: %d of %d lie where nothing is claimed", path, away.sum(), len(away))
    return data.subset(rows), audit.DriveRows(
        place[rows], level[rows], side[rows], data.stations_of()[rows]
    )


def _draw_next(
    call: CommandCall,
    claim: Claim,
    key: str,
    draws: pd.DataFrame | None,
    ratio: np.ndarray,
    part: float,
) -> tuple[pd.DataFrame, str]:
    """All draws, the new ones last, and what is said of these."""
    given, lines = call.given, []
    if given["walkable"] is not None:
        lines = read_shapes(given["walkable"], "walkable", claim.grid.origin, True)[1]
    streets = StreetGraph.from_lines(lines, claim.grid.step / 2) if lines else None
    first = 1 if draws is None else int(draws.tour.max()) + 1
    tours, size = range(first, first + given["tours"]), given["tour"]
    new, ways = audit.sample_tours(claim, key, ratio, part, tours, size, given["seed"], streets)
    for tour, way in zip(tours, ways, strict=True):
        stops = new[new.tour == tour].to_dict("list")
        write_way(call.folder / f"tour_{tour}.geojson", stops, claim.coordinates(way))
    length = sum(float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) for way in ways)
    return (new if draws is None else pd.concat([draws, new], ignore_index=True)), (
        f"drawn: tours {first} to {tours[-1]} of {size} places, {part:.0%} where the claim is in "
        f"doubt, a way of {length / 1000:.3g} km; keep draws.csv as it is, and after the drive "
        "gsparc audit ... drawn=draws.csv rows=FILE"
    )
