"""Errors of powers station by station, and how often the strongest station is told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.evaluation.metric_formats import BEST_SERVER, number_format
from gsparc.evaluation.scores import FEW, Scores
from gsparc.evaluation.table import Column, Table

WORST = 3  # stations shown; the file has all


def errors_by_station(
    error: np.ndarray, station: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, mean and root mean square of errors (n,) of rows of `count` stations, (T,); NaN: no row.

    >>> errors_by_station(np.array([1.0, 3.0, np.nan]), np.array([1, 1, 0]), 2)[1]
    array([nan,  2.])
    """
    known = np.isfinite(error)
    error, station = error[known], station[known]
    rows, total, squares = (np.bincount(station, weight, count) for weight in (None, error, error**2))
    with np.errstate(invalid="ignore"):
        return rows, total / rows, np.sqrt(squares / rows)


def rmse_after_constants(scores: Scores, station: np.ndarray) -> float | None:
    """RMSE [dB] of powers after the mean error of each `station` (n,) of all rows is taken away.

    Stations that nobody calibrated differ by constants which nothing tells of a station never heard.
    """
    rows, bias, rmse = errors_by_station(
        scores.samples["error_db"], station[scores.row], int(station.max()) + 1
    )
    return float(np.sqrt(np.nansum(rows * (rmse**2 - bias**2)) / rows.sum())) if rows.any() else None


def best_server(scores: Scores, data: Measurements) -> dict[str, float]:
    """Return the share of places, with rows of two stations or more, whose measured strongest is predicted.

    What was not heard counts as weaker than all that was. Stations predicted alike share a place, so that
    the order of rows does not count. Empty without such places.
    """
    if data.station is None:
        return {}
    place = np.arange(len(data)) if data.place is None else data.place
    link, of_link = np.unique(
        np.stack([scores.fold, place[scores.row], data.station[scores.row]]), axis=1, return_inverse=True
    )
    of_link = of_link.reshape(-1)
    # A station's rows of one place, of several visits, are one by their strongest.
    predicted, measured = np.full((2, link.shape[1]), -np.inf)
    np.maximum.at(predicted, of_link, scores.samples["prediction"])
    np.maximum.at(measured, of_link, np.nan_to_num(scores.samples["target"], nan=-np.inf))
    start = np.flatnonzero(np.r_[True, (np.diff(link[:2]) != 0).any(0)])
    size = np.diff(np.r_[start, link.shape[1]])
    told = predicted == np.repeat(np.maximum.reduceat(predicted, start), size)
    right = told & (measured == np.repeat(np.maximum.reduceat(measured, start), size))
    used = (size > 1) & np.isfinite(np.maximum.reduceat(measured, start))
    share = np.add.reduceat(right.astype(float), start) / np.add.reduceat(told.astype(float), start)
    return {BEST_SERVER: float(share[used].mean())} if used.any() else {}


def station_columns(methods: Mapping[str, Scores], data: Measurements) -> dict[str, Any]:
    """Return columns (T,) of `by_station.csv`: rows, rmse and bias of methods by the heads' beginning.

    Of stations with scored rows; silent ones count in `rmse_db_with_silent`. Empty without stations.
    """
    if data.site.kind != "rssi" or data.station is None or data.site.stations is None:
        return {}
    columns: dict[str, Any] = {"station": np.array(data.site.stations.shown)}
    for stem, one in methods.items():
        for name in [name for name in ("error_db", "error_db_with_silent") if name in one.samples]:
            rows, bias, rmse = errors_by_station(
                one.samples[name], data.station[one.row], len(columns["station"])
            )
            figure = name.replace("error", "rmse")
            columns.setdefault(figure.replace("rmse_db", "rows"), rows)
            columns[f"{stem}{figure}"] = rmse
            if name == "error_db":
                columns[f"{stem}bias_db"] = bias
    scored = columns[next(reversed([name for name in columns if name.startswith("rows")]))] > 0
    return {name: values[scored] for name, values in columns.items()}


def leads_by_station(columns: Mapping[str, Any], figure: str, baseline: str) -> str:
    """Say at how many stations of `by_station.csv`, with rows enough, a method is better than a baseline."""
    enough = columns[figure.replace("rmse_db", "rows")] >= FEW
    better = columns[figure] < columns[f"baseline/{baseline}/{figure}"]
    return f"{int((better & enough).sum())} of {int(enough.sum())}"


def worst_stations(columns: Mapping[str, Any], method: str) -> list[Table]:
    """Return a table of the stations with the largest rmse, of those with rows enough, if these are several.

    Baselines beside it tell whether a station is hard, or hard for this method.
    """
    enough = np.flatnonzero(columns["rows"] >= FEW) if columns else np.zeros(0, np.int64)
    if len(enough) < 2:
        return []
    worst = enough[np.argsort(-columns["rmse_db"][enough], kind="stable")[:WORST]]
    names = [name for name in columns if name.endswith("/rmse_db") and "/zero/" not in name]
    heads = {"rmse_db": method, "bias_db": "its bias_db", **{name: name.split("/")[1] for name in names}}
    shown = [Column("station", ""), Column("rows", ".0f")]
    shown += [Column(head, number_format("rmse_db")) for head in heads.values()]
    rows = [[columns[name][t] for name in ("station", "rows", *heads)] for t in worst]
    return [Table("rmse_db of the worst stations; by_station.csv has all", shown, rows)]
