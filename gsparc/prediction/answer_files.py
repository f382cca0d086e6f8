"""A model's answers at the places of a file, as a file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsparc.base.errors import DataError
from gsparc.data.schema import ENDS, End, Site
from gsparc.data.target import Target
from gsparc.data.units import PowerUnit, power_in_decibels
from gsparc.models.device_offsets import find_device
from gsparc.models.method import MEAN_DEVICE
from gsparc.prediction.answers import Answers, ask, unit_suffix, write_answers
from gsparc.prediction.hearing import read_hearing
from gsparc.prediction.placing import (
    far_outside_and_margin,
    fill_heights,
    rows_and_stations,
    say_height_error,
    say_tiny_extent,
    to_world,
)
from gsparc.prediction.predictor import Predictor
from gsparc.tables.query_places import QueryPlaces, read_query_places

log = logging.getLogger(__name__)

MOST_ENTRIES = 16  # of a channel, as columns of a table
ENDINGS = (".csv", ".npz")
# Expected errors (N,) [dB] of local places, numbers of stations and deviations [dB];
# NaN where refused.
Tested = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def predict_file(
    predictor: Predictor,
    places: str | Path,
    out: str | Path | None = None,
    *,
    station: str | None = None,
    columns: dict[str, object] | None = None,
    overwrite: bool = False,
    tested: Tested | None = None,
) -> dict[str, Any]:
    """Predict at the places of a file and write the answers; what was guessed is logged.

    Args:
        predictor: of the model.
        places: see `read_query_places`.
        out: *.csv or *.npz; None: beside the places.
        station: name or number of the only one to predict.
        columns: of a table of places, by quantity, where a guess will not do.
        overwrite: whether a file that is there may be replaced.
        tested: expected errors of powers by what was held out, which stand for the model's own
            deviations.

    Returns:
        Facts for `summary.json`.

    Raises:
        DataError: anything that is wrong with the places, the station or the file to write.
    """
    site, places = predictor.site, Path(places)
    path = output_path(None if out is None else str(out), places, overwrite)
    further = site.still_end if site.stations is not None and station is None else None
    found = read_query_places(places, site.moving_ends, columns or {}, further)
    queries = fill_heights(found, site)
    for note in _notes(queries, site):
        log.info("%s: %s", places, note)
    world = to_world(queries, site)
    far, margin = far_outside_and_margin(world, site)
    predictions = predict_places(predictor, queries, world, station, path)
    speck = say_tiny_extent(queries, world, site)
    if speck is not None:
        log.warning("%s: %s", places, speck)
    if far.any():
        log.warning(
            "%s: %d of %d places lie more than %.3g m outside the box of the training places%s, "
            "the first in "
            "%s: predictions there are unreliable",
            places,
            int(far.sum()),
            len(far),
            margin,
            say_height_error(world, site, far),
            queries.rows[int(np.argmax(far))],
        )
    power = site.power_unit(predictor.unit) if site.target.is_level else None
    of_links = len(world) > len(site.moving_ends)
    if power is not None and not of_links:
        predictions = _with_heard(predictor, queries, site.local_places(world), predictions, power)
    states = predictions.said.variance is not None and not of_links
    if tested is not None and power is not None and states:
        local = site.local_places(world)[predictions.place]
        predictions = _with_tested(predictions, local, power, tested)
        if refused := predictions.count_refused():
            refusal = f"{refused} of {len(predictions)} predictions are refused (column refused)"
            log.warning("%s: %s: too far from what was measured", places, refusal)
    write_answers(path, queries, predictions, site, power)
    facts: dict[str, Any] = {
        "predict/places": len(queries),
        "predict/predictions": len(predictions),
        "predict/far_outside": int(far.sum()),
        "predict/refused": predictions.count_refused(),
        "predict/stations": len(np.unique(predictions.names.get("station", ()))),
        "dataset/name": site.name,
        "dataset/kind": site.kind,
        "model/name": predictor.method.name,
        "places": str(places),
        "out": str(path),
        "predict/unit": predictor.unit,
    }
    # A power of 0 is -inf dB, which would be the lowest of every file and no number of a summary.
    mean = predictions.said.mean.numpy()
    values = mean[np.isfinite(mean)]
    empty = ~np.isfinite(mean.reshape(len(mean), -1)).all(axis=1)
    facts["predict/empty"] = int(empty.sum())
    if empty.any():
        why = (
            ("a power of 0, weaker than single precision holds")
            if np.isneginf(mean).any()
            else "no number"
        )
        first = queries.rows[predictions.place[int(np.argmax(empty))]]
        log.warning(
            "%s: %d of %d predictions are empty (%s), the first in %s",
            places,
            empty.sum(),
            len(mean),
            why,
            first,
        )
    if power is not None and len(values):
        ends = {"lowest": float(values.min()), "highest": float(values.max())}
        facts |= {f"predict/{name}_{unit_suffix(power)}": value for name, value in ends.items()}
    return facts


def _with_tested(answers: Answers, local: np.ndarray, power: PowerUnit, tested: Tested) -> Answers:
    """Answers whose deviations are the tested ones; the model's own where they are refused."""
    assert answers.said.variance is not None
    mean = answers.said.mean[:, 0].double().numpy()
    spread = deviation = answers.said.variance.double().sqrt().numpy()
    if not power.decibels:
        with np.errstate(divide="ignore", invalid="ignore"):  # of no power, which has no decibels
            spread = power_in_decibels(mean, deviation**2)[1]
    error = tested(local, answers.station, spread)
    ratio = np.where(np.isnan(error), 1.0, error / np.where(spread > 0, spread, np.nan))
    scaled = torch.from_numpy(deviation * ratio)
    prediction = replace(answers.said, variance=scaled.square())
    return replace(answers, said=prediction, refused=np.isnan(error))


def _with_heard(
    predictor: Predictor,
    queries: QueryPlaces,
    local: np.ndarray,
    answers: Answers,
    power: PowerUnit,
) -> Answers:
    """Answers with levels given that they are heard,
    which `evaluate` judges where rows were chosen so.
    """
    hearing, method, site = read_hearing(predictor.extra), predictor.method, predictor.site
    variance, raised_db = (
        answers.said.variance,
        power.raised_db - site.power_unit(site.level_unit).raised_db,
    )
    # Numbers of stations are those of a whole model: `select_carrier` leaves one.
    whole = predictor.queries.station is None and len(site.every_station) > max(
        hearing.station, default=0
    )
    if not (len(hearing) and whole and power.decibels and method.uses_censored) or variance is None:
        return answers
    device = None
    if queries.device is not None and site.device_names is not None:
        number = {name: find_device(name, site) for name in np.unique(queries.device) if name}
        device = np.array([number.get(name, MEAN_DEVICE) for name in queries.device])[answers.place]
    level_db, spread_db = (
        answers.said.mean[:, 0].numpy() - raised_db,
        variance.double().sqrt().numpy(),
    )
    heard = hearing.given_heard(
        method, local[answers.place], answers.station, level_db, spread_db, device
    )
    heard["heard_db"] += raised_db
    return replace(answers, heard=heard)


def _notes(queries: QueryPlaces, site: Site) -> list[str]:
    notes, origin = list(queries.notes), site.georeference
    # Metres alone may be about any origin, and a wrong one moves all places alike: it is said.
    if origin is not None and not any(where.degrees for where in queries.ends.values()):
        notes.append(
            f"metres are east and north of {origin.latitude:g}, {origin.longitude:g} degrees"
        )
    if queries.station is not None and site.stations is None:
        notes.append("not used: stations; the model has none")
    if queries.device is not None and site.device_names is None:
        notes.append("not used: devices; the model tells none apart")
    return notes


def predict_places(
    predictor: Predictor,
    queries: QueryPlaces,
    world: dict[End, np.ndarray],
    station: str | None,
    path: Path,
) -> Answers:
    """Predict for `path`; stations that cannot be are left out, which is logged.

    Args:
        predictor: of the model.
        queries, station: see `rows_and_stations`.
        world: (n, 3) [m] by end.
        path: spectra for a csv are refused after the first block, before all are predicted.

    Raises:
        DataError: a station that was asked for had too few training rows, or none has a model.
    """
    if len(world) > len(predictor.site.moving_ends):
        return _predict_links(predictor, queries, world, path)
    row, number = rows_and_stations(queries, predictor.site, station)
    named = station is not None or queries.station is not None
    models, silent = list[tuple[Predictor, np.ndarray]](), list[str]()
    device = np.full(len(queries), "") if queries.device is None else queries.device
    # By station: each may have a model of its own, whose matrices are then read once a block.
    for asked_station in np.unique(number):
        chosen = np.flatnonzero(number == asked_station)
        try:
            model = predictor.ask_station(int(asked_station))
        except ValueError as error:
            if named:
                raise DataError(
                    f"{queries.source}, {queries.rows[row[chosen[0]]]}: {error}"
                ) from None
            silent.append(f"left out: {error}")
            continue
        of = device[row[chosen]]
        for name in np.unique(of):
            device_model = _select_device(model, str(name), queries.source)
            models.append((device_model, chosen[of == name]))
    if not models:
        raise DataError(silent[0])
    ends: dict[Any, np.ndarray] = {end: places[row] for end, places in world.items()}
    first = models[0][0].predict(**{end: places[models[0][1][:1]] for end, places in ends.items()})
    refuse_wide_csv(path, predictor.site.target, tuple(first.mean.shape[1:]))
    result = ask(models, ends, what="blocks of places")
    for line in silent:
        log.warning(line)
    rows = np.sort(np.concatenate([asked for _, asked in models]))
    of_row, called = number[rows], predictor.site.every_station.named.items()
    return Answers(row[rows], of_row, {head: np.array(of)[of_row] for head, of in called}, result)


def _predict_links(
    predictor: Predictor, queries: QueryPlaces, world: dict[End, np.ndarray], path: Path
) -> Answers:
    """Answers between places of both ends, whoever stands there."""
    rows, site = np.arange(len(queries)), predictor.site
    try:
        result = ask(predictor, world, what="blocks of places")
    except ValueError as error:
        stays = f"{ENDS[site.still_end]} (station=NAME, or no columns of its places)"
        raise DataError(f"{queries.source}: {error}; ask about a {stays}") from None
    refuse_wide_csv(path, site.target, tuple(result.mean.shape[1:]))
    return Answers(rows, np.zeros_like(rows), {}, result)


def _select_device(predictor: Predictor, device: str, source: str) -> Predictor:
    """The same, answering as a device; empty, or of a model that tells none apart: as it is."""
    if not device or predictor.site.device_names is None:
        return predictor
    try:
        return predictor.select_device(device)
    except ValueError as error:
        raise DataError(f"{source}: {error}; leave it empty for the mean one") from None


def output_path(out: str | None, places: Path, overwrite: bool) -> Path:
    """Return where predictions go: `out`, or beside the places.

    Raises:
        DataError: another ending, the places themselves, or a file that is there already.
    """
    path = places.with_name(f"{places.stem}.predicted.csv") if out is None else Path(out)
    if path.suffix.lower() not in ENDINGS:
        raise DataError(f"out={path}: expected a name ending in {' or '.join(ENDINGS)}")
    # Not a comparison of names: links and other spellings lead to one file, too.
    if path.exists() and path.samefile(places):
        raise DataError(f"out={path}: these are the places themselves; give another out=FILE")
    if path.exists() and not overwrite:
        raise DataError(f"out={path}: the file exists; say overwrite=true, or another out=FILE")
    return path


def refuse_wide_csv(path: Path, target: Target, shape: tuple[int, ...]) -> None:
    """Refuse what is no table: spectra, and channels of many entries."""
    if path.suffix.lower() == ".npz":
        return
    count = int(np.prod(shape))
    if target.is_image:
        size = " x ".join(map(str, shape))
        raise DataError(
            f"out={path}: spectra of {size} directions are no columns; say out=FILE.npz"
        )
    if count > MOST_ENTRIES:
        size = f"{shape[0]} antennas x {shape[1]} subcarriers"
        raise DataError(
            f"out={path}: {size} are more than {MOST_ENTRIES} pairs of columns; say out=FILE.npz"
        )
