"""Predictions at places, station by station."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from gsparc.data.errors import DataError
from gsparc.data.query_places import QueryPlaces
from gsparc.data.schema import End
from gsparc.models.method import Prediction
from gsparc.prediction.predictor import Predictor

CHUNK = 512  # places predicted at a time


@dataclass(frozen=True)
class Answers:
    """N predictions in the order of their places.

    Attributes:
        place: (N,) int64, row of the places.
        station: (N,) names; None where the model has no stations.
        mean: (N, ...) in the units of the measurements.
        variance: (N,) float64, expected squared error per entry; None where the method has none.
        confidence: (N,) float32; None where the method has none.
    """

    place: np.ndarray
    station: np.ndarray | None
    mean: np.ndarray
    variance: np.ndarray | None
    confidence: np.ndarray | None

    def __len__(self) -> int:
        return len(self.place)


def answers(
    predictor: Predictor,
    queries: QueryPlaces,
    world: dict[End, np.ndarray],
    pairs: list[tuple[int, int | None]],
    named: bool,
    accept: Callable[[tuple[int, ...]], None],
) -> tuple[Answers, list[str]]:
    """Predict, and say which stations cannot be.

    Args:
        predictor: of the model.
        queries: for messages.
        world: (n, 3) [m] by end.
        pairs: (row, number of the station) of each prediction.
        named: whether somebody asked for these stations; then one without a model is refused.
        accept: raises where predictions of a shape are not wanted; called after the first ones.

    Raises:
        DataError: a station that was asked for had too few training rows, or none has a model.
    """
    row = np.array([row for row, _ in pairs], np.int64)
    number = np.array([-1 if number is None else number for _, number in pairs], np.int64)
    stations = predictor.site.stations
    parts: list[tuple[np.ndarray, Prediction]] = []
    silent: list[str] = []
    for one in np.unique(number):
        chosen = np.flatnonzero(number == one)
        try:
            asking = predictor if stations is None else predictor.at(stations.name[one])
        except ValueError as error:
            if named:
                raise DataError(f"{queries.source}, {queries.rows[row[chosen[0]]]}: {error}") from None
            silent.append(f"left out: {error}")
            continue
        for start in range(0, len(chosen), CHUNK):
            rows = chosen[start : start + CHUNK]
            said = asking.predict(**{end: places[row[rows]] for end, places in world.items()})
            if not parts:
                accept(tuple(said.mean.shape[1:]))
            parts.append((rows, said))
    if not parts:
        raise DataError(silent[0])
    rows = np.concatenate([rows for rows, _ in parts])
    order = np.argsort(rows, kind="stable")
    whole = Prediction.joined([said for _, said in parts], torch.from_numpy(order))
    spread, sure = (None if v is None else v.numpy() for v in (whole.variance, whole.confidence))
    rows = rows[order]
    names = None if stations is None else np.array(stations.name)[number[rows]]
    return Answers(row[rows], names, whole.mean.numpy(), spread, sure), silent
