"""From the config groups `dataset` and `split` to a `DataModule` and a `Split`."""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
import yaml
from hydra import utils
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from gsparc.base import instantiate
from gsparc.base.errors import DataError, list_first
from gsparc.base.limits import choice
from gsparc.data import spacing, splits
from gsparc.data.foreign import find_foreign
from gsparc.data.outliers import find_outliers
from gsparc.data.row_order import content_order
from gsparc.data.schema import Measurements
from gsparc.data.split_files import read_split
from gsparc.data.split_settings import FileSettings, SplitSettings
from gsparc.data.splits import Split, make_split, remove_rows, rows_to_leave_out
from gsparc.datasets.datamodule import DataModule

log = logging.getLogger(__name__)

# A dataset is a file or a folder: who says the one may mean the other.
PATHS = {"file": "root", "root": "file"}
MADE = {"sionna": "make one with `gsparc simulate`, or "}  # data that nobody publishes


def datamodule(config: Mapping[str, Any], *, trusted: bool = True) -> DataModule:
    """Build the data module that a config of the group `dataset` describes; nothing is read yet.

    Args:
        config: `_target_` and its arguments; without `_target_`, what conf/dataset holds under
            `name`, with these settings.
        trusted: False for text out of a file: then every `_target_` must be a class of gsparc.

    Raises:
        DataError: unknown name or setting, or one that is missing.
        ValueError: a setting that cannot be, or a foreign class.
    """
    settings = _plain(config)
    choices = _choices()
    if "_target_" not in settings:
        settings = _plain(OmegaConf.merge(_choice(settings.get("name"), choices), settings))
    if not trusted:
        for path in instantiate.iterate_targets(settings):
            instantiate.refuse_foreign(path)
    target, name = settings["_target_"], settings.get("name")
    keys = [key for key, node in choices.items() if node["_target_"] == target]
    if keys and name is not None and name not in keys:
        _choice(name, choices)
        raise DataError(f"dataset.name={name}: this is dataset={keys[0]}; say dataset={name}")
    kind = instantiate.import_target(str(target))
    if not callable(kind) or (isinstance(kind, type) and not issubclass(kind, DataModule)):
        only = "; only gsparc locate takes it" if name == "fingerprints" else ""
        raise DataError(
            f"dataset._target_={target} is no gsparc.datasets.datamodule.DataModule{only}"
        )
    has_own = "align" in _parameters(kind)  # Argos turns snapshots by their uplink
    free = "auto" if has_own else str(settings.pop("align", None) or "auto")
    settings = _checked(settings, kind)
    try:  # under its key, which errors then name
        module = utils.instantiate({"dataset": settings}, _convert_="all")["dataset"]
    except InstantiationException as error:
        raise instantiate.cause_of(error) from None
    if not isinstance(module, DataModule):
        raise DataError(f"dataset._target_={target} makes no gsparc.datasets.datamodule.DataModule")
    module.free = free
    return module


def load(config: Mapping[str, Any]) -> Measurements:
    """Read the measurements of `datamodule(config)`.

    Raises:
        DataError: as `datamodule`, missing file, or bad input.
    """
    return datamodule(config).measurements


def split_for(config: Mapping[str, Any], data: Measurements) -> Split:
    """Split `data` as the config group `split` says; `name: file` reads an index file.

    Raises:
        DataError: unknown name or key, impossible shares, or a file made for other data.
    """
    settings = split_settings(config)
    patches = [*find_outliers(data).values()]
    if isinstance(settings.leave_out, str) and settings.leave_out == "foreign":
        patches = [rows for station in find_foreign(data).values() for rows in station]
    wrong = np.concatenate([np.zeros(0, np.int64), *patches])
    if isinstance(settings, FileSettings):
        split = read_split(settings.path, len(data), data.site.sha256)
        absent = rows_to_leave_out(settings.leave_out, wrong, len(data))
        return drop_unanswerable_rows(remove_rows(split, absent) if len(absent) else split, data)
    settings = settings.for_moving_end(data.site.moving_end)
    carriers = (
        None if data.carrier_hz is None else np.unique(data.carrier_hz, return_inverse=True)[1]
    )
    unit = {"runs": data.run, "carriers": carriers}.get(settings.name, data.station)
    place = spacing.group_visits(data.moving, data.place)
    if place is not None and place is not data.place:
        text = (
            "split: %d rows are of %d places: those within a hundredth of the usual step stay "
            "together"
        )
        log.info(text, len(data), len(np.unique(place)))
    # From the lowest place on: where stations stand moves local coordinates,
    # and would move squares.
    where = data.moving - data.moving.min(axis=0)
    order = content_order(data) if settings.name == "none" else data.sequence
    return drop_unanswerable_rows(
        make_split(where, settings, data.release_split, wrong, place, unit, order), data
    )


def drop_unanswerable_rows(
    split: Split, data: Measurements, learned: tuple[Measurements, Split] | None = None
) -> Split:
    """Return the same folds without test rows that plain methods cannot answer.

    Those are of stations with next to no training rows, at unknown places or, of `learned`, not
    expected there. Folds that test such stations alone stay as they are: methods refuse them.

    Args:
        split, data: what is tested.
        learned: what was learned from, and its folds, where it is other data with the same
            stations.
    """
    source, before = learned or (data, split)
    if data.station is None or source.station is None:
        return split
    places, folds = data.site.every_station.position, list[splits.Fold]()
    for fold, old in zip(split.folds, before.folds, strict=True):
        heard = old.train[source.censored_side(old.train) <= 0]
        train, test = (
            np.bincount(source.station[rows], minlength=len(places)) for rows in (heard, old.test)
        )
        usable = (train >= splits.LEAST_ROWS) | ((test > 0) & np.isfinite(places).all(1))
        test_rows = fold.test[usable[data.station[fold.test]]]
        folds.append(replace(fold, test=test_rows) if len(test_rows) else fold)
    pairs = zip(split.folds, folds, strict=True)
    rejects = np.concatenate([np.setdiff1d(old.test, new.test) for old, new in pairs])
    if len(rejects):
        new, rows = np.unique(
            data.station[rejects[data.censored_side(rejects) <= 0]], return_counts=True
        )
        names = [
            f"{data.site.every_station.shown[t]} (in {n} rows)"
            for t, n in zip(new, rows, strict=True)
        ]
        message = "split: %d test rows are left out, of stations with under %d training rows%s"
        heard_now = f"; heard now: {list_first(names, 12)}" if names else ""
        log.warning(message, len(rejects), splits.LEAST_ROWS, heard_now)
    return replace(split, folds=tuple(folds))


def split_settings(config: Mapping[str, Any]) -> SplitSettings | FileSettings:
    """Return what the config group `split` says.

    Raises:
        DataError: unknown name or key, or impossible shares.
    """
    if config.get("name") == "file":
        return instantiate.from_settings(FileSettings, config, "split", "setting of split=file")
    return instantiate.from_settings(SplitSettings, config, "split")


def _plain(config: Mapping[str, Any] | Any) -> dict[str, Any]:
    node = config if isinstance(config, DictConfig) else OmegaConf.create(dict(config))
    return OmegaConf.to_container(node, resolve=True)  # type: ignore[return-value]


@functools.cache
def _choices() -> dict[str, DictConfig]:
    """What conf/dataset holds, by name; settings that come from other groups are left
    to their defaults.
    """
    choices: dict[str, DictConfig] = {}
    for file in files("gsparc.conf").joinpath("dataset").iterdir():
        if file.name.endswith(".yaml"):
            settings = yaml.safe_load(file.read_text(encoding="utf-8"))
            settings.pop("defaults", None)
            choices[file.name.removesuffix(".yaml")] = DictConfig(settings)
    return choices


def _choice(name: Any, choices: Mapping[str, DictConfig]) -> DictConfig:
    choice(*sorted(choices)).check("dataset", str(name))
    return choices[str(name)]


def _parameters(kind: Any) -> dict[str, Any]:
    """What `kind` takes, with defaults; what a dataset hands on
    by keyword is what its reader takes.
    """
    reader, arguments_of = (
        getattr(kind, "reader", lambda path: path),
        instantiate.accepted_arguments,
    )
    _, *read = arguments_of(reader).items()
    return {**dict.fromkeys(getattr(kind, "switches", ())), **dict(read), **arguments_of(kind)}


def _checked(settings: dict[str, Any], kind: Any) -> dict[str, Any]:
    """The settings that `kind` takes, none unknown or missing;
    an unknown one that is null was not said.
    """
    parameters = inspect.signature(kind).parameters.values()
    if any(p.kind is p.VAR_KEYWORD for p in parameters) and not hasattr(kind, "reader"):
        return settings  # it checks them itself
    defaults, accepted, name = _parameters(kind), dict[str, Any](), settings.get("name")
    needed = {key for key, default in defaults.items() if default is inspect.Parameter.empty}
    for key, value in settings.items():
        if value == "???" and key in defaults and key not in needed:
            continue
        if key in defaults or key.startswith("_"):
            accepted[key] = value
        elif value is not None:
            other = PATHS.get(key)
            if other in defaults:
                raise DataError(
                    f"dataset.{key} is not a setting of dataset={name}; say dataset.{other}=..."
                )
            hint = instantiate.suggest_or_list(key, defaults)
            raise DataError(f"dataset.{key}: no such setting of dataset={name}{hint}")
    for key in defaults:
        if key in needed and accepted.get(key) in (None, "", "???"):
            say = f"{MADE.get(str(name), '')}say dataset.{key}={key.upper()} for dataset={name}"
            raise DataError(f"dataset.{key} is not set; {say}")
    return accepted
