"""`gsparc update ckpt=FILE data=NEW out=FILE`: a model with rows that came later,
and what changed.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from gsparc.base.errors import DataError
from gsparc.base.limits import or_null, switch, whole
from gsparc.evaluation.summary import coordinates
from gsparc.evaluation.table import Column, Table
from gsparc.models import checkpoint
from gsparc.prediction.later_rows import check_updatable, read_level_rows
from gsparc.prediction.operating_point import load
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.updating import LIMITS, ToldBefore, versions_extra
from gsparc.runs.open_runs import read_like_stored
from gsparc.runs.output import CommandCall, Result, command
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

OWN_LIMITS = {"undo": whole(0), "batch": or_null(whole(1)), "again": switch()}
# And degrees where they are known
COLUMNS = ("station", "kind", "since", "at", "change_db", "x", "y")


@command(**LIMITS, **OWN_LIMITS)
def task(call: CommandCall) -> Result:
    """Condition a model on a file's rows, or go back."""
    config = call.config
    if (config.data is None) == (config.undo == 0):
        raise DataError(
            "gsparc update: say data=FILE to add rows, or undo=COUNT to take updates back"
        )
    with checkpoint.rewriting(config.ckpt, config.out) as file:
        check_updatable(file.stored.site)  # before the data are read
        predictor = load(file.stored)
        alarms_before, watch, row_count, skipped = len(predictor.alarms), Stopwatch(), 0, 0
        if config.undo:
            predictor.undo(config.undo)
        else:
            row_count, skipped = _add_rows(predictor, file.stored, call.given)
        seconds, out = watch.seconds, config.out or config.ckpt
        file.store(versions_extra(predictor.versions))
    table = alarm_rows(predictor)
    heads = dict.fromkeys([*COLUMNS, *(table or [{}])[0]])
    columns = {name: [row[name] for row in table] for name in heads}
    facts = {
        "ckpt": str(config.ckpt),
        "out": str(out),
        "model/name": predictor.method.name,
        "update/rows_kept": len(predictor.rows),
        "update/alarms": len(table) - alarms_before,
        "update/versions": len(predictor.versions),
        "time/update_s": seconds,
    }
    silent = f", {skipped} skipped (silence where it was expected)" if skipped else ""
    message = f"{row_count} rows added{silent}, alarms: {len(table) - alarms_before}"
    message = f"back by {config.undo}: {len(predictor.rows)} rows kept" if config.undo else message
    message += f", {seconds:.2g} s"
    before = f"update: {message}; model in {out}; summary "
    tables = [changes_table(table)] if table else []
    return Result(facts, tables, (), before, {"changes.csv": columns})


def _add_rows(
    predictor: Predictor,
    stored: checkpoint.StoredModel,
    given: Mapping[str, Any],
) -> tuple[int, int]:
    """Tell the rows of a file; return how many are kept, and how many were skipped."""
    keep_new = predictor.linked_stations is not None
    data, placed = read_like_stored(stored, given["data"], keep_new=keep_new)
    if not placed:
        raise DataError(f"{given['data']}: has no places; later rows need them")
    how = {name: given[name] for name in ("window", "false_alarm")}
    rows, row_count, skipped = read_level_rows(data, predictor.site), 0, 0
    size, content = given["batch"] or len(rows), rows.content()
    if content in predictor.told and not given["again"]:
        fault = f"the same rows were told to {given['ckpt']} before"
        raise ToldBefore(f"{given['data']}: {fault}; again=true tells them once more")
    for start in range(0, len(rows), size):
        refit = given["refit"] and start + size >= len(rows)
        key = content if start == 0 and not given["again"] else None
        added = predictor.update(
            rows.subset(slice(start, start + size)), refit=refit, key=key, **how
        )
        row_count, skipped = row_count + len(added.rows), skipped + added.skipped
    return row_count, skipped


def alarm_rows(predictor: Predictor) -> list[dict[str, Any]]:
    """Return alarms as rows of `changes.csv`: names of stations, places in world coordinates."""
    rows = []
    for alarm in predictor.alarms:
        name = (
            "all" if alarm.station < 0 else (predictor.stations or ["the station"])[alarm.station]
        )
        where = coordinates(np.array([[*alarm.place, 0.0]]), predictor)
        place = {axis: float(value[0].round(7)) for axis, value in where.items() if axis != "z"}
        values = name, alarm.kind, alarm.since, alarm.at, round(alarm.change_db, 2)
        rows.append({**dict(zip(COLUMNS, values, strict=False)), **place})
    return rows


def changes_table(rows: list[dict[str, Any]]) -> Table:
    """Return what changed, as people read it."""
    columns = [
        Column(name, ".1f" if name in ("change_db", "x", "y") else "", of=name) for name in COLUMNS
    ]
    return Table.from_rows(
        "What changed: kind, numbers of rows, dB, about where [m]", columns, rows[-20:]
    )
