"""The door to answers at many places: in blocks, and as a CSV or npz file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsparc.base.executor import run_all
from gsparc.base.files import write_archive, write_samples
from gsparc.data.schema import Site
from gsparc.data.target import Kind
from gsparc.data.units import LINEAR, PowerUnit
from gsparc.models.method import Prediction
from gsparc.prediction.predictor import Predictor
from gsparc.tables.query_places import QueryPlaces

# 512 spectra of 90 x 360 pixels take 66 MB in float32; an interrupt is heeded after a block
BLOCK = 512  # places asked about at a time
DIGITS = 6  # of decibels: `evaluate` and an error computed from the file agree so far


@dataclass(frozen=True)
class Answers:
    """N predictions in the order of their places.

    Attributes:
        place: (N,) int64, row of the places.
        station: (N,) its number; 0 where there is one.
        names: (N,) of stations by heads of columns, see `Stations.named`; empty where the model has
            none.
        said: (N, ...) in the predictor's unit.
        refused: (N,) bool, as maps refuse places; None where no error was tested.
        heard: (N,) in the predictor's unit, of powers given that they are heard, see
            `Hearing.given_heard`, by the names of its results;
            empty where the model learned of no silence.
    """

    place: np.ndarray
    station: np.ndarray
    names: dict[str, np.ndarray]
    said: Prediction
    refused: np.ndarray | None = None
    heard: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.place)

    def count_refused(self) -> int | None:
        """Return how many are refused; None where no error was tested."""
        return None if self.refused is None else int(self.refused.sum())


def in_blocks(rows: np.ndarray) -> list[np.ndarray]:
    """Return rows (n, ...) in blocks of at most `BLOCK`."""
    return np.split(rows, range(BLOCK, len(rows), BLOCK))


def ask(
    models: Predictor | Sequence[tuple[Predictor, np.ndarray]],
    ends: Mapping[Any, np.ndarray],
    *,
    linear: bool = False,
    what: str = "",
    threads: int = 1,
) -> Prediction:
    """Return what is predicted at world places, in their order.

    >>> ask(predictor, {"rx": np.zeros((2000, 3))}).mean.shape
    torch.Size([2000, 1])

    Args:
        models: who is asked, each with the numbers (m,) of its places; one alone: all of them.
        ends: by end, (n, 3) places, or (3,) of one that stands still [m].
        linear: powers as such, whose levels are in `site.level_unit`.
        what, threads: see `run_each`.

    Raises:
        ValueError: as `Predictor.predict`.
    """
    count = max(len(np.atleast_2d(places)) for places in ends.values())
    models = [(models, np.arange(count))] if isinstance(models, Predictor) else models
    blocks = [(model, part) for model, rows in models for part in in_blocks(rows)]

    def predicted(block: tuple[Predictor, np.ndarray]) -> Prediction:
        model, rows = block
        where: Any = {end: at if at.ndim == 1 else at[rows] for end, at in ends.items()}
        unit = LINEAR if linear and model.site.target.is_level else None
        return model.predict(**where, unit=unit)

    parts = run_all(predicted, blocks, what, threads=threads)
    order = np.argsort(np.concatenate([rows for _, rows in blocks]), kind="stable")
    return Prediction.joined(parts, torch.from_numpy(order))


def unit_suffix(unit: PowerUnit) -> str:
    """Return the ending of columns and figures of powers: `db` of any levels, else the unit."""
    return "db" if unit.decibels else unit.name


def write_answers(
    path: Path, queries: QueryPlaces, predictions: Answers, site: Site, power: PowerUnit | None
) -> None:
    """Write all predictions, whole or not at all; NaN for the level of no power."""
    archive, kind = path.suffix.lower() == ".npz", site.kind
    columns, name = (
        _places(queries, predictions),
        kind if power is None else f"{kind}_{unit_suffix(power)}",
    )
    outputs, mean = predictions.said, predictions.said.mean.numpy()
    if power is not None:
        columns[name] = np.where(np.isfinite(mean[:, 0]), mean[:, 0], np.nan)
        columns[name] = (
            columns[name].round(DIGITS) if power.decibels else columns[name].astype(np.float32)
        )
    if outputs.variance is not None:
        # Stored as a variance because those of independent parts add;
        # a reader wants it in the level's unit.
        columns[f"{name}_std"] = outputs.variance.sqrt().float().numpy()
    if power is None:
        mean = site.in_shape_of_file(mean) if site.target.is_complex else mean
        columns |= {kind: mean} if archive else _entries(kind, mean)
    columns |= {name: values.round(DIGITS) for name, values in predictions.heard.items()}
    columns |= {} if outputs.confidence is None else {"confidence": outputs.confidence.numpy()}
    columns |= (
        {} if predictions.refused is None else {"refused": predictions.refused.astype(np.int8)}
    )
    if not archive:
        columns = _in_order(columns, queries, predictions)
        # A float32 is written with as many digits as tell it from its neighbours,
        # .1 and not .10000000149.
        write_samples(path, {name: list(values) for name, values in columns.items()})
        return
    write_archive(path, columns)


def _places(queries: QueryPlaces, predictions: Answers) -> dict[str, np.ndarray]:
    """Coordinates as they were given, and the station."""
    columns = {} if queries.name is None else {"row_name": queries.name[predictions.place]}
    for end, where in queries.ends.items():
        before = "" if len(queries.ends) == 1 else f"{end}_"
        axes = ("latitude", "longitude", "height") if where.degrees else ("x", "y", "z")
        for axis, values in zip(axes, where.all().T, strict=True):
            columns[before + axis] = values[predictions.place]
    return columns | predictions.names


def _in_order(
    columns: dict[str, np.ndarray], queries: QueryPlaces, predictions: Answers
) -> dict[str, np.ndarray]:
    """The columns of a table of places in its order, those that were not read as they are,
    then the rest.
    """
    ordered: dict[str, np.ndarray] = {}
    used_names: list[str] = []
    for head, role, words in queries.table:
        # With one end that moves columns have no prefix; "^$" takes nothing away.
        axis = re.sub("^(rx|tx)_" if len(queries.ends) == 1 else "^$", "", role or "")
        names = [
            name
            for name in (axis, axis.replace("z", "height"))
            if name in {*columns} - {*used_names}
        ]
        if role is not None and names:
            # As they were written: 48.191910 is no 48.19191 to a join. Names of stations under any
            # other head are repeated: which columns there are depends on the model alone.
            used_names.append(head if role == "station" else names[0])
            ordered[head] = words[predictions.place]
        elif role is None:
            # A user's own column called like one of ours keeps its words under another head.
            ordered[f"{head} (given)" if head in columns else head] = words[predictions.place]
    rest = {name: values for name, values in columns.items() if name not in used_names}
    return {**ordered, **rest}


def _entries(kind: Kind, values: np.ndarray) -> dict[str, np.ndarray]:
    """Entries, of channels real and imaginary parts; with their numbers on axes of several."""
    columns: dict[str, np.ndarray] = {}
    for place in np.ndindex(values.shape[1:]):
        counts = zip(place, values.shape[1:], strict=True)
        number = "".join(f"_{index}" for index, count in counts if count > 1)
        entry = values[:, *place]
        parts = {"_re": entry.real, "_im": entry.imag} if np.iscomplexobj(values) else {"": entry}
        columns |= {f"{kind}{part}{number}": column for part, column in parts.items()}
    return columns
