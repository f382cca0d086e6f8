"""Errors of powers station by station, and how often the strongest station is told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gsparc.data.schema import Measurements, show_names
from gsparc.data.spacing import squares_of_extent
from gsparc.evaluation.metric_formats import BEST_SERVER, number_format
from gsparc.evaluation.scores import FEW, Scores
from gsparc.evaluation.table import Column, Table
from gsparc.tables.links.strongest import strongest_lists

WORST = 3  # stations shown; the file has all
OFFSET = 0.5  # of the squared errors of a station, that one offset explains
# Chance at which a station is missed; most that a prediction is trusted
BY_CHANCE, SURE = 0.02, 0.999
NEAR_M = 50.0  # of a list, whose stations another should hold: shadowing is alike
# Of heard rows; of silent ones what predictions exceed
ERRORS = ("error_db", "error_db_with_silent")


def rmse_after_constants(scores: Scores, station: np.ndarray) -> float | None:
    """Return RMSE [dB] of powers after the mean error of each `station` (n,)
    of all rows is taken away.

    Stations that nobody calibrated differ by constants which nothing tells
    of a station never heard.
    """
    error = pd.Series(scores.samples["error_db"])
    residual = error - error.groupby(station[scores.row]).transform("mean")
    return float((residual**2).mean() ** 0.5) if residual.notna().any() else None


def score_best_server(scores: Scores, data: Measurements) -> dict[str, float]:
    """Return the share of places, with rows of two stations or more,
    whose measured strongest is predicted.

    What was not heard counts as weaker than all that was; in lists of the strongest all that is not
    listed, see `score_strongest_station`. Of k stations tied as predicted strongest a right one
    counts 1 / k. Empty without such places.
    """
    row, place = scores.row, np.arange(len(data)) if data.place is None else data.place
    if "strongest_told" in scores.samples:
        answers = (
            pd.Series(scores.samples["strongest_told"]).groupby([scores.fold, place[row]]).first()
        )
        return {BEST_SERVER: float(answers.mean())}
    # A receiver in saturation reports its most: what is at least that has no target,
    # but is the strongest.
    most = np.where(data.censored_side(row) < 0, data.powers(row)[:, 0], np.nan)
    answers = scores.samples.get("served", scores.samples["prediction"])
    table = pd.DataFrame(
        {
            "fold": scores.fold,
            "place": place[row],
            "station": data.stations_of(row),
            "predicted": answers,
            "measured": np.fmax(scores.samples["target"], most),
        }
    )
    # A station's rows of one place, of several visits, are one by their strongest.
    links = table.groupby(["fold", "place", "station"]).max()
    strongest = links == links.groupby(["fold", "place"]).transform("max")
    strongest["right"] = strongest.predicted & strongest.measured
    places = strongest.groupby(["fold", "place"])
    sums = places.sum()[(places.size() > 1) & places.measured.any()]
    return {BEST_SERVER: float((sums.right / sums.predicted).mean())} if len(sums) else {}


def unlisted_stations(scores: Scores, data: Measurements) -> pd.DataFrame:
    """Return stations that no list holds though lists should, a row each: `moments`, `expected`,
    `chance`.

    Of `moments` `expected` should list the station. Moments of one square of floor err together and
    count as one, by their largest probability: a station that is there stays out of all with at
    most this `chance`. Empty of other data than lists of the strongest.
    """
    shares = scores.never_listed
    if shares is None or not len(shares):
        return pd.DataFrame(columns=["moments", "expected", "chance"])
    assert data.place is not None
    moments, first = np.unique(data.place, return_index=True)
    square = squares_of_extent(data.moving[first, :2])[np.searchsorted(moments, shares.moment)]
    missed = 1 - shares.groupby(["station", square]).share.max().clip(upper=SURE)
    table = shares.groupby("station").agg(moments=("share", "size"), expected=("share", "sum"))
    table["chance"] = missed.groupby("station").prod()
    return table[table.chance < BY_CHANCE]


def newly_listed(old: Measurements, new: Measurements) -> pd.DataFrame:
    """Return stations that lists of a later drive hold and none of the earlier, a row each.

    Columns `lists`: of the later drive that hold it; `expected`: earlier ones that should, by how
    often they hold what the later list within `NEAR_M` has at the same place among its stations, of
    stations that both drives heard; `chance` that none does though the station was there, squares
    counted as by `unlisted_stations`. Empty of other data than lists of the strongest.
    """
    before, now = strongest_lists(old), strongest_lists(new)
    if before is None or now is None:
        return pd.DataFrame(columns=["lists", "expected", "chance"])
    gap, near = cKDTree(now.place).query(before.place)
    pairs = np.flatnonzero(gap <= NEAR_M)
    was_listed, listed, later = (
        np.isfinite(before.level)[pairs],
        np.isfinite(now.level),
        near[pairs],
    )
    is_known = np.isfinite(before.level).any(0)
    fresh = np.flatnonzero(listed.any(0) & ~is_known)
    # Equal levels keep the order of the stations, on any processor.
    order = np.argsort(np.where(listed, -now.level, np.inf), 1, kind="stable")
    rank = np.argsort(order, 1)[later]
    links = pd.DataFrame({"rank": rank[:, is_known][listed[later][:, is_known]]})
    links["held"] = was_listed[:, is_known][listed[later][:, is_known]]
    again = links.groupby("rank").held.mean().reindex(range(listed.shape[1])).fillna(0.0).to_numpy()
    share = np.where(listed[later], again[rank], 0.0)[:, fresh]
    missed = np.ones((0, len(fresh)))
    if len(pairs):
        squares = squares_of_extent(before.place[pairs, :2])
        missed = 1 - pd.DataFrame(share).groupby(squares).max().clip(upper=SURE).to_numpy()
    figures = {"lists": listed[:, fresh].sum(0), "expected": share.sum(0), "chance": missed.prod(0)}
    return pd.DataFrame(figures, index=fresh)


def describe_new(old: Measurements, new: Measurements) -> str | None:
    """Return stations of `newly_listed` in words, the surest first; None without."""
    stations = newly_listed(old, new).sort_values("chance")
    if not len(stations):
        return None
    names = np.array(new.site.every_station.shown)[stations.index]
    surely = np.where(stations.chance < BY_CHANCE, "new", "new, or out of its reach before")
    rows = zip(names, stations.lists, stations.expected, surely, stations.chance, strict=True)
    return ", ".join(
        f"{n} (in {k} lists, for {e:.0f} of the earlier drive: {s}; chance {c:.0e})"
        for n, k, e, s, c in rows
    )


def describe_never_listed(scores: Scores, data: Measurements) -> str | None:
    """Return stations of `unlisted_stations` in words, the surest first; None without."""
    stations = unlisted_stations(scores, data).sort_values("chance")
    if not len(stations):
        return None
    names = np.array(data.site.every_station.shown)[stations.index.astype(int)]
    rows = zip(names, stations.expected, stations.moments, stations.chance, strict=True)
    return ", ".join(f"{n} (in {e:.0f} of {r:.0f} lists; chance {c:.0e})" for n, e, r, c in rows)


def station_columns(methods: Mapping[str, Scores], data: Measurements) -> dict[str, Any]:
    """Return columns of `by_station.csv`: rows, rmse and bias of methods by the heads' beginning.

    Of stations with scored rows; silent ones count in `rmse_db_with_silent`.
    Empty without stations.
    """
    columns: dict[str, Any] = {}
    if not (called := data.site.every_station.named):
        return columns
    for stem, method in methods.items():
        for name in [name for name in ERRORS if name in method.samples]:
            error = pd.DataFrame(
                {"mean": method.samples[name], "square": method.samples[name] ** 2}
            )
            by, figure = error.groupby(data.stations_of(method.row)), name.replace("error", "rmse")
            means, rows = by.mean(), by["mean"].count()
            for head, names in called.items():
                columns.setdefault(head, np.array(names)[rows.index])
            columns |= {name.replace("error_db", "rows"): rows, stem + figure: means.square**0.5}
            columns |= {f"{stem}bias_db": means["mean"]} if name == ERRORS[0] else {}
    return {name: np.asarray(values) for name, values in columns.items()}


def worst_stations(columns: Mapping[str, Any], method: str, later: bool = False) -> list[Table]:
    """Return a table of the stations with the largest rmse, of those with rows enough,
    if these are several.

    Of a `later` log, no row of which was learned from, it names the command that learns offsets.
    Baselines beside it tell whether a station is hard, its note at how many the method is better.
    """
    # Among the baselines may be the method itself.
    names = [
        column
        for column in columns
        if column.endswith("/rmse_db") and column.split("/")[1] not in ("zero", method)
    ]
    heads = {
        "rmse_db": method,
        "bias_db": f"bias_db of {method}",
        **{name: name.split("/")[1] for name in names},
    }
    table_columns = [Column("station", "", of="station"), Column("rows", ".0f", of="rows")]
    table_columns += [
        Column(head, number_format("rmse_db"), of=name) for name, head in heads.items()
    ]
    stations = pd.DataFrame(columns, columns=None if columns else ["rows", "rmse_db"])
    rows = stations[stations["rows"] >= FEW].sort_values("rmse_db", ascending=False, kind="stable")
    if len(rows) < 2:
        return []
    better = ", ".join(
        f"than {heads[name]} at {(rows.rmse_db < rows[name]).sum()}" for name in names
    )
    compared = f"of {len(rows)} stations ({FEW} rows or more)"
    note = f"{method} has the smaller rmse_db {better} {compared}" if names else ""
    title = "rmse_db of the worst stations; by_station.csv has all"
    named = rows.assign(station=show_names(rows["station"], rows.get("cell")))
    offset = named[rows.bias_db**2 > OFFSET * rows.rmse_db**2] if "bias_db" in rows else rows[:0]
    if len(offset):
        those = ", ".join(
            f"{itertuple.station} ({-itertuple.bias_db:+.1f} dB)"
            for itertuple in offset[:WORST].itertuples()
        )
        note += f"{'; ' * bool(note)}measured levels differ from predicted by one offset: {those}"
        if later:
            note += ": gsparc update learns that, but not from lists of the strongest"
    return [Table.from_rows(title, table_columns, named[:WORST].to_dict("records"), note=note)]
