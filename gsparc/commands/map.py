"""`gsparc map ckpt=FILE`: received power over an area with a promised error."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.output import finish, run_directory
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.errors import DataError
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.evaluation.open_runs import open_files
from gsparc.maps.field_map import FieldMap, geotiff_wanted, write_geotiff
from gsparc.maps.floor_plan import FloorPlan, read_plan
from gsparc.maps.intervals import Coverage
from gsparc.maps.making import map_of
from gsparc.maps.page import write_page
from gsparc.maps.pictures import draw_layer, file_name, layers
from gsparc.maps.promise import Promise, PromiseSettings, gather, stored_promise
from gsparc.models import checkpoint
from gsparc.models.method import Method
from gsparc.models.registry import build
from gsparc.prediction.operating_point import load
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import peak_memory
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)


def promise_of(path: str, dataset: dict[str, Any], settings: PromiseSettings, renew: bool) -> Promise:
    """The evidence stored with a model, or gathered from its training data and then stored.

    Raises:
        DataError: the training data are gone, or are others.
    """
    stored = checkpoint.read(path)
    found = None if renew else stored_promise(stored.extra)
    if found is not None and (settings.block_m is None or settings.block_m == found.block_m):
        return found
    if "model" not in stored.configuration:
        raise DataError(
            f"{path}: does not say how it was trained; say promised=false for a map without promise"
        )
    method, make, data, fold, context = trained(path, dataset)
    log.info("a promise for this map: %d fits without blocks of places", settings.folds)
    found = gather(method, make, data, fold, settings, context)
    found.coverage(settings.share)  # too little evidence is said before anything is stored
    found.keep(path)
    return found


def trained(
    path: str, dataset: dict[str, Any]
) -> tuple[Method, Callable[[], Method], Measurements, Fold, FitContext]:
    """A model, an unfitted copy, the very data and rows that it was trained on, and how.

    Raises:
        DataError: they are gone, or are others.
    """
    try:
        run = open_files([path], dataset)
    except (ValueError, OSError) as error:
        raise DataError(
            f"{error}; held-out blocks need the training data: dataset.file=..., or promised=false"
        ) from None
    if run.learned != 0 or run.foreign is not None:
        raise DataError(f"{path} was trained on {run.foreign}; give its own data, or promised=false")
    config = run.stored[0].configuration
    context = FitContext(
        seed=int(config.get("seed", 0)), budget_s=config.get("budget_s"),
        budget_clock=config.get("budget_clock", "wall"), stations=config.get("stations", "each"),
    )  # fmt: skip
    make = partial(build, config["model"], trusted=False)
    return run.methods[0], make, run.data, run.split.folds[0], context


def plan_of(config: DictConfig) -> FloorPlan | None:
    """The floor plan that a configuration names."""
    settings = plain(config)
    if settings["plan"] is None:
        if settings["plan_points"] is not None:
            raise DataError("plan_points: goes with an image, plan=FILE")
        return None
    return read_plan(settings["plan"], settings["plan_points"])


def coordinates(places: np.ndarray, predictor: Predictor | None) -> dict[str, np.ndarray]:
    """Columns of a table of places (n, 3) [m], in degrees, too, where the model knows its place on Earth."""
    columns = dict(zip(("x", "y", "z"), places.T.round(4), strict=True))
    if predictor is not None and predictor.site.georeference is not None and len(places):
        latitude, longitude, _ = predictor.degrees(places)
        columns |= {"latitude": latitude.round(8), "longitude": longitude.round(8)}
    return columns


def settings_of(config: DictConfig) -> RunSettings:
    """The settings of a run, of which `stations` is not one here: it holds names."""
    return RunSettings.of(OmegaConf.masked_copy(config, [str(key) for key in config if key != "stations"]))


def stations_of(given: Any) -> list[str | int] | None:
    """Names or numbers; None for `all`.

    Raises:
        DataError: neither.
    """
    if given is None or given == "all":
        return None
    if isinstance(given, str | int):
        return [given]
    if not isinstance(given, list):
        raise DataError(f"stations={given}: all, a name or a list of names is needed")
    return given


def lines_of(found: FieldMap, kept: Coverage | None) -> list[str]:
    """What a reader of the map must know."""
    said = [*found.notes]
    share = found.figures()["map/server_unsure"]
    if share and len(found.stations) > 1:
        said.append(
            f"best_server: in {share:.1%} of the cells (hatched) the station named is less likely than not "
            "the strongest and above its floor; noise_db=... says where noise lies"
        )
    if kept is None:
        said.append(
            "no promise: intervals are the model's own deviations, and places far from data are not refused"
        )
        return said
    refused = found.figures()["map/refused"]
    said.append(
        f"in {found.share:.0%} of the cells a measurement is promised to lie in its interval: of {kept.rows} "
        f"rows in {kept.blocks} held-out blocks {kept.share:.1%} did (mean width {kept.width_db:.1f} dB; the "
        f"model's own deviations: {kept.own_share:.1%}, {kept.own_width_db:.1f} dB)"
    )
    if refused:
        said.append(
            f"{refused} of {int(found.grid.inside.sum())} cells are refused: too far from what was measured"
        )
    return said


def task(config: DictConfig) -> dict[str, Any]:
    """Map, draw and write; returns the facts of `summary.json`."""
    settings_of(config)
    run_dir, settings = run_directory(), plain(config)
    floor = plan_of(config)
    predictor = load(config.ckpt)
    how = PromiseSettings(**settings["promise"])
    asked = {
        "area": settings["area"], "height_m": config.height_m, "step_m": config.step_m,
        "threshold_db": float(config.threshold_db), "stations": stations_of(settings["stations"]),
        "load": settings["load"], "noise_db": config.noise_db, "other_end": settings["other_end"],
        "plan": floor, "share": how.share, "tolerance_db": float(config.tolerance_db),
    }  # fmt: skip
    map_of(predictor, dry=True, **asked)  # refuses what cannot be before any evidence is gathered
    geotiff_wanted(config.geotiff, predictor.site.georeference)
    promise = None
    if config.promised:
        promise = promise_of(str(config.ckpt), settings["dataset"], how, bool(config.renew))
    found = map_of(predictor, promise=promise, **asked)
    kept = None if promise is None else promise.coverage(how.share)
    lines = lines_of(found, kept)
    unit = str(config.unit or predictor.site.level_unit)
    drawn = list(layers(found, unit))
    size = f"height {found.grid.height:g} m, cells of {found.grid.step:.3g} m"
    title = f"{predictor.site.name}, {predictor.method.label}: {size}"
    found.save(run_dir / "map.npz")
    for layer in drawn if config.pictures else ():
        draw_layer(found, layer, run_dir / file_name(layer), title, floor)
    origin = predictor.site.georeference
    if origin is not None and geotiff_wanted(config.geotiff, origin):
        write_geotiff(run_dir / "map.tif", found, origin)
    write_page(run_dir / "map.html", found, drawn, title, lines, floor)
    facts = {
        **found.figures(), "dataset/name": predictor.site.name, "dataset/kind": predictor.site.kind,
        "model/name": predictor.method.name, "ckpt": str(config.ckpt), "promise/share": how.share,
        "promise/calibrated": int(promise is not None), **peak_memory(),
    }  # fmt: skip
    if kept is not None and promise is not None:
        reach = promise.calibration(how.share).reach
        facts |= {f"promise/held/{name}": value for name, value in vars(kept).items()}
        facts |= {"promise/reach_m": reach, "promise/block_m": promise.block_m}
    before = f"{facts['map/cells']} cells, {facts['map/stations']} station(s); map "
    return finish(run_dir, facts, lines=lines, before=before)
