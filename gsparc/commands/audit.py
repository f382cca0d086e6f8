"""`gsparc audit claim=map.tif threshold_dbm=-110 share=0.95`: does a published map hold?"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gsparc.apps.maps import audit as audits
from gsparc.apps.maps import audit_report
from gsparc.apps.maps.against_rows import drive_of
from gsparc.apps.maps.claim import Claim, read_claim
from gsparc.apps.maps.claim_errors import ClaimErrors, doubts_before_rows
from gsparc.apps.maps.geojson import read_shapes
from gsparc.apps.maps.making import MOST_DB
from gsparc.apps.maps.streets import StreetGraph
from gsparc.base.errors import DataError, list_first
from gsparc.base.limits import POSITIVE, choice, number, or_null, whole
from gsparc.data.schema import Measurements
from gsparc.datasets.own import read_any
from gsparc.evaluation.by_part import describe_parts
from gsparc.pictures.parts import draw_parts
from gsparc.prediction.levels import measured_levels
from gsparc.runs.output import CommandCall, Result, command

log = logging.getLogger(__name__)

LIMITS = {
    "threshold_dbm": or_null(number(-MOST_DB, MOST_DB)),
    "share": number(0, 1, open_low=True, open_high=True),
    "tour": whole(1, 1000),
    "tours": whole(0, 1000),
    "step_m": or_null(POSITIVE),
    "reach_m": or_null(POSITIVE),
    "unreached": choice("against", "outside"),
}
LEAST_ROWS = 10  # that a process of errors is learned from


@command(**LIMITS)
def task(call: CommandCall) -> Result:
    """Judge the tours that were driven, draw the next ones, write and draw."""
    given, folder = call.given, call.folder
    threshold, within = given["threshold_dbm"], given["within_db"]
    both = (-within, within) if isinstance(within, int | float) else within and tuple(within)
    question = audits.Question(threshold, float(given["share"]), both)
    settings = {name: given[name] for name in ("station", "area", "step_m", "places")}
    claim = read_claim(given["claim"], threshold_db=threshold, **settings)
    key, reach = audits.digest_of(claim, question), given["reach_m"] or claim.step
    draws = None if given["drawn"] is None else audits.read_draws(given["drawn"], key, claim)
    facts = {"audit/claim": claim.digest, "audit/key": key, "audit/places": len(claim)}
    facts |= {"audit/asked": question.words, "audit/seed": given["seed"]}
    lines = [f"claim: {question.words}; {len(claim)} places of {claim.step:.3g} m"]
    rows, data, outcome, part = None, None, None, 0.5
    parts, figures = list[dict[str, Any]](), list[Figure]()
    columns: dict[str, Mapping[str, Any]] = {}
    margin = claim.level - threshold if threshold is not None else np.full(len(claim), np.nan)
    if np.isnan(margin).all():
        margin = np.zeros(len(claim))
    chance = doubts_before_rows(margin) if threshold is not None else None
    if given["rows"] is not None:
        data, rows = _read_rows(given, claim)
        facts["audit/rows"] = sha256(Path(given["rows"]).read_bytes()).hexdigest()[:16]
        claimed, errors = _errors(claim, rows, threshold)
        if errors is not None and threshold is not None:
            chance = errors.chance_below(claim.place, margin)
        if draws is None:
            lines.append("rows that nobody drew give no verdict: a model's estimate alone")
            if errors is not None and threshold is not None:
                share, low, high = errors.share(claim.place, margin)
                told = f"{share:.1%} hold, 90 % interval {low:.1%} to {high:.1%}"
                lines.append(f"by a model of these rows {told}, if the model is right")
                names = ("audit/model_share", "audit/model_low", "audit/model_high")
                facts |= dict(zip(names, (share, low, high), strict=True))
        else:
            outside = given["unreached"] == "outside"
            outcome = audits.judge(claim, draws, rows, question, reach, outside)
            part = _next_part(outcome, draws, chance, len(claim))
            lines += _tell(outcome, question, outside)
            facts |= _facts(outcome)
            begun = draws[: len(outcome.low)]
            columns["capital.csv"] = {
                **{name: begun[name] for name in ("tour", "stop", "place", "x", "y")},
                **{name: getattr(outcome, name) for name in ("reached", "low", "high", "weight")},
                "stands": outcome.stands,
                "falls": outcome.falls,
            }
            figures.append(audit_report.draw_capital(outcome))
        if np.isfinite(claimed).any():
            found, parts = _parts(data, rows, claimed, folder)
            lines += found
            if parts:
                columns["by_part.csv"] = {name: [row[name] for row in parts] for name in parts[0]}
    if given["tours"] and (outcome is None or outcome.verdict == "open"):
        ratio = audits.doubt_ratio(chance, len(claim))
        draws, told = _draw_next(call, claim, key, draws, ratio, part)
        lines = [question.power(given["tours"] * given["tour"]), *lines, told]
    if draws is not None:
        columns["draws.csv"] = {name: draws[name] for name in draws}
    audit_report.draw_audit(claim, chance, draws, rows, folder / "audit.png")
    layers = {"claim_db": claim.level, "chance_of_failing": chance}
    if claim.grid.inside.sum() == len(claim):
        told_layers = {name: layer for name, layer in layers.items() if layer is not None}
        audit_report.write_audit_tiff(folder / "audit.tif", claim, told_layers)
    title = Path(str(given["claim"])).name
    note = f"claim {claim.digest}, audit {key}, rows {facts.get('audit/rows', 'none')}"
    audit_report.write_page(folder, title, note, lines, facts, parts, figures)
    return Result(facts, (), lines, "audit.html ", columns)


def _read_rows(given: Mapping[str, Any], claim: Claim) -> tuple[Measurements, audits.DriveRows]:
    """Rows of what is audited, none twice, in the claim's metres."""
    path = given["rows"]
    beside = {k: v for k, v in given["dataset"].items() if k not in ("file", "name")}
    data = read_any(path, **beside).data
    if not data.site.maps_levels:
        raise DataError(f"rows={path}: no levels of one end that moves")
    if given["threshold_dbm"] is not None and data.site.level_unit not in ("dBm", "dB"):
        raise DataError(f"rows={path}: in {data.site.level_unit}, and the threshold is in dBm")
    if data.site.level_unit == "dB":
        log.warning("rows=%s: levels state no unit; they are taken for dBm", path)
    level, side = measured_levels(data, np.arange(len(data)))
    station, names = data.stations_of(), list(data.site.every_station.shown)
    kept = np.isfinite(level)
    if given["station"] is not None and names:
        if given["station"] not in names:
            raise DataError(f"rows={path}: no station {given['station']} in {list_first(names)}")
        kept &= station == names.index(given["station"])
    place = data.moving[:, -3:-1] + data.site.origin[:2]
    at = claim.local(place, data.site.georeference, f"rows={path}")
    once = np.unique(np.c_[at, level, station], axis=0, return_index=True)[1]
    twice = int(kept.sum() - kept[once].sum())
    if twice:
        log.warning("rows=%s: %d rows stand there twice and count once", path, twice)
    kept &= np.isin(np.arange(len(kept)), once)
    if not kept.any():
        raise DataError(f"rows={path}: no level is known in it")
    away = audits.outside(claim, at[kept], given)
    if away.any():
        log.warning("rows=%s: %d of %d lie where nothing is claimed", path, away.sum(), len(away))
    kept[kept] = ~away
    rows = audits.DriveRows(at[kept], level[kept], side[kept], station[kept])
    return data.subset(np.flatnonzero(kept)), rows


def _errors(
    claim: Claim, rows: audits.DriveRows, threshold: float | None
) -> tuple[np.ndarray, ClaimErrors | None]:
    """Claimed levels (n,) of rows, and the process of claimed less measured ones."""
    claimed = claim.level[claim.nearest(rows.place, claim.step)]
    base = np.where(np.isfinite(claimed), claimed, threshold or 0.0)
    few = len(np.unique(rows.place, axis=0)) < LEAST_ROWS
    return claimed, None if few else ClaimErrors.from_rows(rows.place, base - rows.level)


def _parts(
    data: Measurements, rows: audits.DriveRows, claimed: np.ndarray, folder: Path
) -> tuple[list[str], list[dict[str, Any]]]:
    """Lines and records of where claimed less measured is off."""
    error = np.where(rows.side == 0, claimed - rows.level, np.nan)
    drive = drive_of(data, np.arange(len(data)), error, np.full(len(error), np.nan), 0.9)
    parts = drive.judge()
    lines = [line.replace("predicted", "claimed") for line in describe_parts(parts, 0.9)]
    if parts:
        draw_parts(drive, parts, "claimed less measured", folder / "drive.png")
    if (line := audit_report.fit_line(rows.place, claimed, rows.level)) is not None:
        lines.append(f"measured over claimed: slope {line[0]:.2f} +- {line[1]:.2f}")
    return lines, parts


def _tell(outcome: audits.Outcome, question: audits.Question, outside: bool) -> list[str]:
    missed = int((~outcome.reached).sum())
    low, high = audits.even_rate(outcome)
    where = " of the reachable area" if outside and missed else ""
    lines = [
        f"verdict{where}: {outcome.verdict} after {outcome.rows} drawn places in "
        f"{len(outcome.ends)} tours (wrong in 5 % of audits at most, each way)"
    ]
    if question.threshold_db is not None:
        lines.append(f"of the places drawn, weighed, {low:.1%} to {high:.1%} hold")
    if missed:
        how = "are left out" if outside else "count against both verdicts"
        lines.append(f"{missed} drawn places have no row within reach: they {how}")
    return lines


def _facts(outcome: audits.Outcome) -> dict[str, Any]:
    capital = {"stands": outcome.stands, "falls": outcome.falls}
    return {
        "audit/verdict": outcome.verdict,
        "audit/drawn": outcome.rows,
        "audit/missed": int((~outcome.reached).sum()),
        **{f"audit/capital_{name}": float(path[-1]) for name, path in capital.items() if len(path)},
    }


def _next_part(
    outcome: audits.Outcome, draws: pd.DataFrame, chance: np.ndarray | None, count: int
) -> float:
    """Which part of the next tours is drawn by doubt, see `doubt_part`."""
    before = draws.ratio.to_numpy()[: len(outcome.low)]
    doubt = audits.doubt_ratio(chance, count)
    failed = np.where(outcome.reached, 1 - outcome.high, 0.0)
    return audits.doubt_part(outcome.weight, failed, before, doubt)


def _draw_next(
    call: CommandCall,
    claim: Claim,
    key: str,
    draws: pd.DataFrame | None,
    ratio: np.ndarray,
    part: float,
) -> tuple[pd.DataFrame, str]:
    """All draws, the new ones last, and what is said of them."""
    given, lines = call.given, []
    if given["walkable"] is not None:
        lines = read_shapes(given["walkable"], "walkable", claim.origin, True)[1]
    streets = StreetGraph.from_lines(lines, claim.step / 2) if lines else None
    first = 1 if draws is None else int(draws.tour.max()) + 1
    part = part if np.ptp(ratio) > 0 else 0.0
    new, ways = audits.draw_tours(
        claim,
        key,
        ratio,
        part,
        range(first, first + given["tours"]),
        given["tour"],
        given["seed"],
        streets,
        given["start"],
    )
    audit_report.write_ways(call.folder / "draws.geojson", claim, new, ways)
    length = sum(float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) for way in ways)
    told = f"drawn: tours {first} to {first + len(ways) - 1} of {given['tour']} places"
    told += f", {part:.0%} where the claim is in doubt, a way of {length / 1000:.1f} km; keep "
    told += "draws.csv as it is, and drive it whole: gsparc audit ... drawn=draws.csv rows=FILE"
    return (new if draws is None else pd.concat([draws, new], ignore_index=True)), told
