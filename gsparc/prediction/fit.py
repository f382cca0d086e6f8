"""`gsparc.fit(...)`: a model of measurements in arrays, as `gsparc train` makes it of a file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.errors import Caution, DataError
from gsparc.base.instantiate import accepted_arguments, suggest_or_list
from gsparc.data.row_order import order_rows
from gsparc.data.schema import Measurements
from gsparc.data.split_settings import SplitSettings
from gsparc.data.splits import Fold
from gsparc.data.units import LINEAR, PowerUnit
from gsparc.datasets.campaign import find_implausible
from gsparc.models import checkpoint, fitting
from gsparc.models.per_station import wrap_per_station
from gsparc.models.registry import method_class
from gsparc.prediction.hearing import Hearing
from gsparc.prediction.predictor import Predictor
from gsparc.tables.checks.coherence import set_unknown_factor
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw
from gsparc.training.context import FitContext
from gsparc.training.effort import refuse_seconds

log = logging.getLogger(__name__)

VALIDATED = SplitSettings().val_fraction


def fit(
    rx: Any = None,
    tx: Any = None,
    *,
    rssi: Any = None,
    csi: Any = None,
    spectrum: Any = None,
    unit: str = "dBm",
    model: str = "gsparc",
    effort: float = 1.0,
    seed: int = 0,
    save: str | Path | None = None,
    settings: dict[str, Any] | None = None,
    terms: Sequence[Any] | Any = (),
    align: str = "auto",
    **arrays: Any,
) -> Predictor:
    """Fit a model to all rows, ready to be asked;
    checks and messages are those of a file of one's own.

    Where no handler of `logging` shows them, stages are shown on stderr as they end.

    >>> predictor = gsparc.fit(rx=places, tx=[12.0, 30.0, 2.6], rssi=powers_dbm)
    >>> predictor.rssi(rx=[[3.0, 4.0, 1.5]]).shape
    (1, 1)
    >>> predictor.unit, predictor.std(rx=[[3.0, 4.0, 1.5]]).shape
    ('dBm', (1, 1))

    Args:
        rx, tx: (n, 3) places of the receiver and of the transmitter [m], (3,) of the one that
            stands still.
        rssi: (n,) received powers in `unit`; (n, T) of T stations.
        csi: (n,), (n, subcarriers) or (n, antennas, subcarriers) complex channels.
        spectrum: (n, elevations, azimuths) directional spectra.
        unit: of `rssi`, and of what is answered: dBm, dBW, dB (of a reference nobody knows), W, mW,
            ...
        model: a name of `gsparc train --help`.
        effort: that searches, rows and steps are multiplied by: .3 is quick, 3 thorough.
        seed: of whatever is random.
        save: a checkpoint to write, for `gsparc.load` and all commands.
        settings: arguments of the model's class.
        terms: further terms of one station's powers, see `docs/terms.md`; of gsparc and powers.
        align: what of each row's factor is free in channels: `none`, `phase`, `phase+delay` or
            `phase+delay+gain`; `auto`: as neighbouring rows say.
        **arrays: anything else of the schema of `docs/reference/schema.md`: `carrier_hz`,
            `frequency_hz`, `array_position`, `station_position`, ...

    Raises:
        DataError: arrays that `gsparc check` would refuse, all problems with array and row.
        ValueError: no such model or setting, one that cannot learn these measurements, or no unit
            of powers.
    """
    refuse_seconds(arrays)
    inputs = {"rx_position": rx, "tx_position": tx, "csi": csi, "spectrum": spectrum, **arrays}
    columns = {name: _array_of(value) for name, value in inputs.items() if value is not None}
    raw = Raw(columns, {}) if rssi is None else _raw_powers(columns, _array_of(rssi), unit)
    raw.attributes["name"] = "arrays"  # the source is of messages
    try:
        reading = interpret(raw, "gsparc.fit")
    except DataError as refused:
        # An array here
        text = "; ".join(refused.problems).replace("dataset.frequency_hz", "frequency_hz")
        raise DataError(text) from None
    none = np.zeros(0, np.int64)
    data, _ = order_rows(set_unknown_factor(reading.data, align), Fold(none, none, none))
    for note in [*reading.notes, *find_implausible(reading.data, reading.file_row)[0]]:
        log.warning("%s", note)
    kind, options = (
        method_class(model),
        {**(settings or {}), **({} if terms == () else {"terms": terms})},
    )
    for name in options.keys() - accepted_arguments(kind):
        raise ValueError(
            f"settings: model={model!r} has no "
            f"{name!r}{suggest_or_list(name, accepted_arguments(kind))}"
        )
    factory = wrap_per_station(kind(**options), data)
    fold = _split_validation(data, VALIDATED if factory.takes_effort else 0.0, seed)
    context = FitContext(seed=seed, effort=effort)
    with ExitStack() as before:
        if not log.hasHandlers():  # nobody shows what is logged, and a fit may take minutes
            shown, handler = logging.getLogger("gsparc"), logging.StreamHandler()
            before.callback(shown.setLevel, shown.level)
            before.callback(shown.removeHandler, handler)
            shown.addHandler(handler)
            shown.setLevel(logging.INFO)
        method, report = fitting.fit_or_resume(factory, data, fold, context)
    for note in report.notes:
        log.log(logging.WARNING if isinstance(note, Caution) else logging.INFO, "%s", note)
    extra = {"train_s": report.seconds, **Hearing.from_learned(data, fold.learned()).to_extra()}
    if save is not None:
        checkpoint.save(save, method, extra=extra)
    site = replace(data.site, device_levels=method.fitted_site.device_levels)
    return Predictor(method, site, extra=extra)


def _array_of(value: Any) -> np.ndarray:
    """As an array; what is masked has no value."""
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind in "iuf":
        value = value.astype(np.float64)
    return value.filled(np.nan) if isinstance(value, np.ma.MaskedArray) else np.asarray(value)


def _raw_powers(arrays: dict[str, np.ndarray], powers: np.ndarray, unit: str) -> Raw:
    """Arrays of the schema with powers in a unit: watts, or decibels as they are."""
    stations = powers.shape[1] if powers.ndim == 2 else 1
    for end in ("rx", "tx"):
        shape = arrays.get(f"{end}_position", np.zeros(0)).shape
        if 1 < stations != len(powers) and shape[:1] == (stations,) and len(shape) == 2:
            text = (
                f"{end} and rssi are of {stations} stations: say station_position= in place "
                f"of {end}="
            )
            raise DataError(f"gsparc.fit: {text}")
    unknown = unit in ("dB", LINEAR)  # what they refer to
    power_unit = PowerUnit.from_name(str(unit), "dB" if unknown else "dBW")
    if power_unit.decibels:
        return Raw({**arrays, "rssi_db": powers}, {"level_unit": power_unit.name})
    if "noise_variance" in arrays:
        # A variance scales with the square of the unit.
        arrays = {**arrays, "noise_variance": arrays["noise_variance"] / power_unit.scale**2}
    if powers.dtype.kind in "iuf":  # others are refused by name
        powers = powers / power_unit.scale
    about = {"unit": power_unit.name, "level_unit": "dB" if unknown else "dBW"}
    return Raw({**arrays, "rssi": powers}, about)


def _split_validation(data: Measurements, share: float, seed: int) -> Fold:
    """All rows; those at a share of the places validate. Nothing is left to test on."""
    rows = np.arange(len(data))
    places, which = np.unique(rows if data.place is None else data.place, return_inverse=True)
    held_out = np.random.default_rng(seed).permutation(len(places))[: round(share * len(places))]
    validates = np.isin(which.reshape(-1), held_out)
    return Fold(rows[~validates], rows[validates], rows[:0])
