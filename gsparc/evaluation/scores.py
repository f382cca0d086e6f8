"""Per-sample results of predictions on chosen rows, pooled over folds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.data.schema import Measurements, Scored
from gsparc.data.splits import Fold, Split
from gsparc.data.units import power_in_decibels
from gsparc.evaluation.metric_formats import OF_KIND
from gsparc.evaluation.metrics import power_errors
from gsparc.models.method import Method
from gsparc.models.predicting import predict_in_batches
from gsparc.physics.decibels import from_decibels
from gsparc.prediction.hearing import Hearing, levels_near
from gsparc.tables.links.strongest import StrongestLists, levels_db, strongest_lists

SUBSETS = ("train", "val", "test")
# 64 spectra of 90 x 360 pixels take 8 MB in float32, and their targets as much.
CHUNK = 64  # rows predicted at a time
FEW = 10  # rows: one of fewer may well be most of the error
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class Scores:
    """Results of one method, sample by sample, in the order of the folds.

    Attributes:
        kind: see `Site.scored`.
        fold, row: (S,) int64.
        samples: quantities of the metrics of `kind`, (S,) float64 each.
        confidence, variance: (S,) float64, NaN where the method gives none.
        never_listed: see `predict_unlisted_stations`; None of other data than lists.
    """

    kind: Scored
    fold: np.ndarray
    row: np.ndarray
    samples: dict[str, np.ndarray]
    confidence: np.ndarray
    variance: np.ndarray
    never_listed: pd.DataFrame | None = None

    def figures(self) -> dict[str, float | None]:
        """Return flat figures over all folds together."""
        return OF_KIND[self.kind].metric.summary(self.samples)

    def dominant_row(self) -> dict[str, Any]:
        """Return the row that alone makes over half of all error or power,
        and a figure that no row decides.

        `decided_by/row`, `decided_by/share` and `decided_by/nmse_median`, the median over rows of
        |e|^2 /
        |h|^2; empty where no row weighs so much, there are few, or errors are in decibels.
        """
        error, power = (
            self.samples.get("error_power", self.samples["mse"]),
            self.samples["target_power"],
        )
        valid = np.isfinite(error) & (power > 0)
        if "error_db" in self.samples or valid.sum() < FEW:
            return {}
        error, power, row = error[valid], power[valid], self.row[valid]
        # A row may decide by its error alone, or by its power, which NMSE divides by.
        shares = np.maximum(error / max(error.sum(), TINY), power / power.sum())
        worst = int(shares.argmax())
        if shares[worst] <= 0.5:
            return {}
        median = float(np.median(error / power))
        facts = {"row": int(row[worst]), "share": float(shares[worst]), "nmse_median": median}
        return {f"decided_by/{name}": value for name, value in facts.items()}


def errors_with_silent(
    samples: Mapping[str, np.ndarray], row: np.ndarray, data: Measurements
) -> dict[str, np.ndarray]:
    """Return `error_db_with_silent` (S,): of silent rows what predictions exceed their level.

    {} where none is.
    """
    side = data.censored_side(row)
    if not side.any():
        return {}
    beyond = side * power_errors(samples["prediction"], data.powers(row)[:, 0])["error_db"]
    return {
        "error_db_with_silent": np.where(side == 0, samples["error_db"], np.maximum(beyond, 0.0))
    }


def rows_to_score(fold: Fold, eval_on: str) -> np.ndarray:
    """Return rows of the subset `train`, `val` or `test`.

    Raises:
        ValueError: another name, or an empty subset.
    """
    if eval_on not in SUBSETS:
        raise ValueError(f"eval_on={eval_on!r} is none of {', '.join(SUBSETS)}")
    rows = getattr(fold, eval_on)
    if not len(rows):
        raise ValueError(f"eval_on={eval_on}: the split has no {eval_on} rows")
    return rows


def unseen_runs(data: Measurements, fold: Fold, eval_on: str) -> np.ndarray:
    """Return numbers (R,) of runs with channels among the rows `eval_on` and none among those
    learned from.
    """
    if data.site.scored != "csi" or data.run is None:
        return np.zeros(0, np.int64)
    return np.setdiff1d(data.run[getattr(fold, eval_on)], data.run[fold.learned(eval_on)])


def best_phase_of_runs(
    method: Method, data: Measurements, rows: np.ndarray, runs: np.ndarray
) -> Tensor:
    """Return what predictions of rows (n,) are turned by, (n,) complex64:
    the best phase of each of `runs`.

    A run has a phase of its own, which nothing tells of one that was not learned from.
    """
    turn = torch.ones(len(rows), dtype=torch.complex64)
    for run in runs:
        mine, overlap = np.flatnonzero(data.run[rows] == run), 0j  # type: ignore[index]
        for _, batch, prediction in predict_in_batches(method, data, rows[mine], CHUNK):
            # complex128: a sum over many rows and entries loses digits in complex64.
            product = (prediction.mean.cpu().conj() * batch.target).to(torch.complex128)
            overlap += complex((product if batch.mask is None else product * batch.mask).sum())
        if overlap:
            # arg of sum conj(p) t maximises Re sum conj(p e^ja) t over a:
            # the best phase in closed form.
            turn[torch.from_numpy(mine)] = torch.tensor(
                overlap / abs(overlap), dtype=torch.complex64
            )
    return turn


def score_methods(
    methods: Sequence[Method],
    data: Measurements,
    split: Split,
    eval_on: str = "test",
    learned: tuple[Measurements, Split] | None = None,
    means: list[Tensor] | None = None,
    off: Sequence[int] = (),
    hearing: Sequence[Hearing] | None = None,
) -> Scores:
    """Predict the chosen rows of every fold with that fold's method.

    Channels of runs that it did not learn from are scored after the best common phase of each.
    Where it learned from silent rows, and the chosen ones do not name every station at each place,
    heard rows are judged by `Hearing.given_heard`, which are among the samples:
    column `heard_db` of `gsparc predict`.

    Args:
        methods: one fitted method per fold.
        data: the dataset.
        split: as the methods were fitted with.
        eval_on: `train`, `val` or `test`.
        learned: what the methods learned from, where it is not `data` and `split`.
        means: which the mean of every batch is added to.
        off: stations that are not scored and fill no list of the strongest.
        hearing: what each method learned of silence; None: as the rows tell that it learned from.

    Raises:
        ValueError: another number of methods than folds, an empty subset, a prediction with NaN.
    """
    if len(methods) != len(split.folds):
        raise ValueError(
            f"{len(methods)} methods for the {len(split.folds)} folds of split={split.name}"
        )
    scored_rows, samples = [rows_to_score(fold, eval_on) for fold in split.folds], []
    scored_rows = (
        [rows[~np.isin(data.stations_of(rows), off)] for rows in scored_rows]
        if len(off)
        else scored_rows
    )
    missing: list[pd.DataFrame] = []
    learned_data, before = learned or (data, split)
    if hearing is None:
        hearing = [Hearing.from_learned(learned_data, fold.learned()) for fold in before.folds]
    limited = any(map(len, hearing)) and not names_every_station(data, np.concatenate(scored_rows))
    are_lists = limited and strongest_lists(data) is not None
    of_folds = zip(methods, scored_rows, split.folds, before.folds, hearing, strict=True)
    for method, rows, fold, taught, silence in of_folds:
        runs = unseen_runs(data, fold, eval_on)
        # Before scoring: the phase is found on all rows of a run, chunks alone would each have one.
        turn = best_phase_of_runs(method, data, rows, runs) if len(runs) else None
        metric = OF_KIND[data.site.scored].metric(data.site.target_scale)
        outputs = {name: np.full(len(rows), np.nan) for name in ("confidence", "variance")}
        order = []
        for chosen, batch, prediction in predict_in_batches(method, data, rows, CHUNK):
            mean = prediction.mean if turn is None else prediction.mean * turn[chosen, None, None]
            metric.update(mean, batch.target, batch.mask)
            if means is not None:
                means.append(mean)
            for name, values in outputs.items():
                if (output := getattr(prediction, name)) is not None:
                    values[chosen] = output.detach().cpu().double().numpy()
            order.append(chosen)
        # Metrics are in the order of updates, station by station;
        # rows are wanted in that of the fold.
        back = np.argsort(np.concatenate(order))
        scored = {name: values[back] for name, values in metric.compute().items()} | outputs
        if method.name == "nearest" and data.site.target.is_level and data.station is not None:
            learned_rows = np.sort(taught.learned(eval_on))
            scored["served"] = levels_of_nearest_moment(
                learned_data.subset(learned_rows), data.subset(rows)
            )
        if limited:
            variance = scored["variance"] * data.site.target_scale**2
            # Of no power, which has no decibels
            with np.errstate(divide="ignore", invalid="ignore"):
                level = power_in_decibels(scored["prediction"], variance)
            queries, told = data.subset(rows), silence.without(np.asarray(off, np.int64))
            if told.lists is not None and are_lists:
                scored["strongest_told"] = score_strongest_station(method, told.lists, queries)
                missing.append(
                    predict_unlisted_stations(
                        method, told, data.subset(np.concatenate(scored_rows)), queries
                    )
                )
            heard = told.given_heard(
                method, queries.moving, queries.stations_of(), *level, queries.device
            )
            # Who learned from heard rows alone predicts such levels.
            scored |= heard if method.uses_censored else {"heard_share": heard["heard_share"]}
        samples.append(scored)
    pooled = {name: np.concatenate([s[name] for s in samples]) for name in samples[0]}
    row = np.concatenate(scored_rows)
    pooled |= errors_with_silent(pooled, row, data)
    if "heard_db" in pooled:
        pooled |= power_errors(from_decibels(pooled["heard_db"]), pooled["target"])
    return Scores(
        kind=data.site.scored,
        fold=np.repeat(np.arange(len(scored_rows)), [len(rows) for rows in scored_rows]),
        row=row,
        confidence=pooled.pop("confidence"),
        variance=pooled.pop("variance"),
        samples=pooled,
        never_listed=pd.concat(missing) if missing else None,
    )


def names_every_station(data: Measurements, rows: np.ndarray) -> bool:
    """Tell whether every station of the file was heard at each place of rows (n,):
    then nothing was chosen.

    Levels of others are what was strong enough to be heard or listed.
    """
    place = np.arange(len(data)) if data.place is None else data.place
    named = data.censored_side(rows) <= 0
    if data.mask is not None:  # saturated rows have no target, but name their station
        named &= data.mask[rows].reshape(len(rows), -1).any(1) | (data.censored_side(rows) < 0)
    links = np.unique(np.c_[place[rows], data.stations_of(rows)][named], axis=0)
    return len(links) == len(np.unique(place[rows])) * len(np.unique(data.stations_of()))


def predict_unlisted_stations(
    method: Method, hearing: Hearing, data: Measurements, asked: Measurements
) -> pd.DataFrame:
    """Return how probably lists hold stations that none of them does: columns `station`, `moment`,
    `share`.

    Of every moment that was asked about, not of a choice of unlisted rows; levels are as the method
    predicts them. Empty of methods that do not know what lists leave out.

    Args:
        method: fitted.
        hearing: what it learned of lists.
        data, asked: all rows that are scored, and some of them, in its coordinates.
    """
    table = pd.DataFrame({"station": [], "moment": [], "share": []}, dtype=float)
    if not method.uses_censored:
        return table
    assert asked.place is not None and hearing.lists is not None
    heard = data.stations_of()[data.censored_side() <= 0]
    absent = np.setdiff1d(np.flatnonzero(np.isfinite(hearing.lists.level).any(0)), heard)
    if not len(absent):
        return table
    moment, first = np.unique(asked.place, return_index=True)
    levels = levels_near(method, hearing.lists, asked.moving[first])
    share = np.zeros((len(moment), len(absent)))
    at, column = np.nonzero(np.isfinite(levels[0][:, absent]))
    own = levels[:, at, absent[column]]
    share[at, column] = hearing.given_listed(levels, own, at, absent[column])[0]
    columns = np.tile(absent, len(moment)), np.repeat(moment, len(absent)), share.ravel()
    return pd.DataFrame(dict(zip(table, columns, strict=True)))


def score_strongest_station(
    method: Method, lists: StrongestLists, asked: Measurements
) -> np.ndarray:
    """Return at rows (n,) of moments whether the measured strongest station is the predicted one of
    all.

    Every station that was listed nearby is asked about, listed here or not: what a list of the
    strongest leaves out is weaker. Of k stations tied
    as predicted strongest a right one counts 1 / k.
    """
    assert asked.place is not None
    _, first, which = np.unique(asked.place, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    if method.name == "nearest":  # the nearest moment as it was, not each station's own
        finite = np.isfinite(lists.place).all(1)
        level = lists.level[finite][cKDTree(lists.place[finite]).query(asked.moving[first])[1]]
        level = np.nan_to_num(level, nan=-np.inf)
    else:
        level = levels_near(method, lists, asked.moving[first])[0]
    measured = np.full(level.shape, -np.inf)
    heard = np.flatnonzero(asked.censored_side() <= 0)
    np.maximum.at(measured, (which[heard], asked.stations_of(heard)), levels_db(asked, heard))
    best, predicted_best = (levels == levels.max(1, keepdims=True) for levels in (measured, level))
    predicted_best &= np.isfinite(level)
    share = (best & predicted_best).sum(1) / np.maximum(predicted_best.sum(1), 1)
    return np.where(np.isfinite(measured.max(1)), share, np.nan)[which]


def levels_of_nearest_moment(learned: Measurements, asked: Measurements) -> np.ndarray:
    """Return levels (n,), linear, of stations of rows asked at the nearest place learned from;
    0 if unheard.

    The strongest of the nearest moment, as anyone would tell a best server; levels of each
    station's own nearest moments tell it worse (simulated lists of three .30 to .36 for .48
    to .76 of the places).
    """
    station, heard = asked.stations_of(), np.flatnonzero(learned.censored_side() <= 0)
    places, which = np.unique(learned.moving[heard], axis=0, return_inverse=True)
    table = np.zeros((len(places), max(learned.stations_of().max(), station.max()) + 1))
    np.maximum.at(table, (which.reshape(-1), learned.stations_of(heard)), learned.target[heard, 0])
    return table[cKDTree(places).query(asked.moving)[1], station]
