"""Predictions of many rows: in batches, on as many threads as pay, in double precision."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.data.moments import Snapshots
from gsparc.data.query import Batch, Query
from gsparc.data.schema import Measurements
from gsparc.models.method import DOUBLE, MEAN_DEVICE, Method, Prediction, T
from gsparc.physics.row_factors import align_factors


def predict_in_batches(
    method: Method, data: Measurements, rows: np.ndarray, size: int = 64
) -> Iterator[tuple[np.ndarray, Batch, Prediction]]:
    """Yield which of rows (n,) were asked together, as numbers (b,) into these, their batch,
    and the answer.

    One station after the other: each may have a model of its own, whose matrices are read for every
    batch. Where rows have factors of their own (`Site.unknown_factor`),
    answers are turned to what was measured.
    """
    order = np.argsort(data.stations_of(rows), kind="stable")

    def predict_batches() -> Iterator[tuple[np.ndarray, Batch, Prediction]]:
        for start in range(0, len(rows), size):
            chosen = order[start : start + size]
            batch = data.batch(rows[chosen])
            answer = method.predict(batch)
            # Else rows are the mean device's
            if method.site is not None and data.site.device_levels is None:
                device = (
                    MEAN_DEVICE
                    if data.device is None
                    else torch.from_numpy(data.device[rows[chosen]])
                )
                answer = answer.of_devices(method.site, device, batch.station)
            yield chosen, batch, answer

    if data.site.unknown_factor == "none":
        yield from predict_batches()
        return
    answers, back = list(predict_batches()), np.argsort(order)
    factors = factors_to_measured(
        torch.cat([answer.mean.detach().cpu() for _, _, answer in answers])[back], data, rows
    )
    for chosen, batch, answer in answers:
        factor = factors[chosen]
        variance = (
            None
            if answer.variance is None
            else answer.variance * factor[:, 0].abs().square().mean(1)
        )
        yield chosen, batch, replace(answer, mean=answer.mean * factor, variance=variance)


def factors_to_measured(means: Tensor, data: Measurements, rows: np.ndarray) -> Tensor:
    """Return factors (n, 1, K) complex64 that turn means (n, A, K) to rows (n,)
    by what is free of these.
    """
    moments = Snapshots.from_rows(data, rows)
    answers = moments.arrange(means.numpy())
    turns = align_factors(
        answers * (moments.values != 0), moments.values, moments.tones, data.site.unknown_factor
    )
    return torch.from_numpy(moments.to_rows(turns).astype(np.complex64))


def to_double(part: T) -> T:
    """Return a copy of anything that pickles, its tensors constants in float64 or complex128.

    What is of these types already, and arrays of NumPy, are shared and not copied.
    """
    tensors: dict[int, Any] = {}  # alive as long as their numbers are asked for

    class Parts(pickle.Pickler):
        def persistent_id(self, value: Any) -> int | None:
            if not isinstance(value, Tensor | np.ndarray):
                return None
            tensors[id(value)] = value
            return id(value)

    class Doubled(pickle.Unpickler):
        def persistent_load(self, number: int) -> Any:
            value = tensors[number]
            if isinstance(value, Tensor):
                tensors[number] = value = value.detach().to(DOUBLE.get(value.dtype, value.dtype))
            return value

    whole = io.BytesIO()
    Parts(whole, pickle.HIGHEST_PROTOCOL).dump(part)
    whole.seek(0)
    result: T = Doubled(whole).load()
    return result


@contextmanager
def suitable_threads(method: Method, places: int) -> Iterator[None]:
    """Run with as many CPU threads as suit a query: one for a single place, whose parts are small.

    On a busy machine two threads that wait for each other take up to a hundred times as long.
    """
    before = torch.get_num_threads()
    if before == 1 or places > 1 or method.threads_pay:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def predict_with_threads(method: Method, query: Query) -> Prediction:
    """Return what a method predicts, by as many threads as suit the query."""
    with suitable_threads(method, len(query)):
        return method.predict(query)
