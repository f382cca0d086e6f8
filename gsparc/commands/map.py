"""`gsparc map ckpt=FILE`: received power over an area with a promised error."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import Any

from gsparc.apps.maps.area import read_plan_settings
from gsparc.apps.maps.covered import covered_share_interval
from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.geojson import read_outlines
from gsparc.apps.maps.geotiff import check_geotiff, write_classes, write_geotiff, write_kmz
from gsparc.apps.maps.intervals import cross_validate
from gsparc.apps.maps.layers import Layer, add_changes, change_layers, file_name, list_layers
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.pictures import draw_layer
from gsparc.apps.maps.promise import PromiseSettings, map_notes, read_or_gather
from gsparc.base.errors import DataError
from gsparc.base.files import write_samples
from gsparc.prediction.timing import peak_memory
from gsparc.runs.open_runs import open_run
from gsparc.runs.output import CommandCall, Result, command

SUFFIXES = (".png", ".pdf", ".svg")  # of pictures


def stations_of(setting: Any) -> list[str | int] | None:
    """Return names or numbers; None for `all`.

    Raises:
        DataError: neither.
    """
    if setting is None or setting == "all":
        return None
    if isinstance(setting, str | int):
        return [setting]
    if not isinstance(setting, list):
        raise DataError(f"stations={setting}: all, a name or a list of names is needed")
    return setting


def _layers(field: FieldMap) -> list[Layer]:
    return [*list_layers(field), *change_layers(field)]


def _pictures(call: CommandCall, field: FieldMap) -> list[str]:
    """Patterns of the files that layers are drawn to.

    Raises:
        DataError: `save` that no layer's file matches.
    """
    save = [] if call.given["save"] is None else [str(call.given["save"])]
    names = [file_name(layer, suffix) for layer in _layers(field) for suffix in SUFFIXES]
    if save and not any(fnmatch(name, save[0]) for name in names):
        pdf_names = ", ".join(name for name in names if name.endswith(".pdf"))
        raise DataError(
            f"save={save[0]}: no layer's file is called so; there are *.pdf, *.svg, {pdf_names}"
        )
    return [*(["*.png"] if call.given["pictures"] else []), *save]


@command()
def task(call: CommandCall) -> Result:
    """Map, draw and write."""
    run_dir, config, floor = call.folder, call.config, read_plan_settings(call.given)
    run = open_run(config.ckpt, call.given["dataset"])
    predictor, other = run.predictor, call.given["other_end"]
    if anywhere := other is not None and predictor.site.stations is not None:
        predictor, other = predictor.stand_at(other), None
    how = PromiseSettings(**call.given["promise"])
    query = {
        "area": call.given["area"],
        "height_m": config.height_m,
        "step_m": config.step_m,
        "threshold_db": float(config.threshold_db),
        "stations": stations_of(call.given["stations"]),
        "load": call.given["load"],
        "noise_db": config.noise_db,
        "other_end": other,
        "plan": floor,
        "share": how.share,
        "tolerance_db": float(config.tolerance_db),
        "unit": config.unit,
        "buildings": config.buildings,
        "indoor_db": call.given["indoor_db"],
    }
    # Refuses what cannot be before any evidence is gathered.
    first = add_changes(predict_map(predictor, dry=True, **query), predictor, dry=True)
    wanted = _pictures(call, first)
    # Refused before evidence is gathered, which takes minutes.
    tiff = check_geotiff(config.geotiff)
    promise = None if anywhere else read_or_gather(run, call.given, renew=config.renew)
    field = add_changes(predict_map(predictor, promise=promise, **query), predictor)
    coverage = None if promise is None else cross_validate(promise.evidence, how.share)
    ends = None if promise is None else covered_share_interval(field, predictor, promise)
    lines = map_notes(field, coverage, ends, promise)
    size = f"height {field.grid.height:g} m, squares of {field.grid.step:.3g} m"
    layers = _layers(field)
    of_one = {f"power {station}" for station in field.stations}
    title = f"{predictor.site.name}, {predictor.method.label}: {size}"
    behind = read_outlines(call.given, field.grid.origin)
    field.save(run_dir / "map.npz")
    for layer in layers:
        for suffix in SUFFIXES:
            name = file_name(layer, suffix)
            if any(fnmatch(name, pattern) for pattern in wanted):
                folder = run_dir / "stations" if layer.name in of_one else run_dir
                folder.mkdir(exist_ok=True)
                draw_layer(field, layer, folder / name, title, floor, behind)
        if layer.words:
            write_samples(run_dir / file_name(layer, ".csv"), layer.class_table())
        if layer.words and tiff:
            write_classes(
                run_dir / file_name(layer, ".tif"), field, layer.values, layer.words, layer.table()
            )
    if tiff:
        write_geotiff(run_dir / "map.tif", field)
    if tiff and field.grid.origin is not None:
        write_kmz(
            run_dir / "map.kmz", field, [layer for layer in layers if layer.name not in of_one]
        )
    facts = {
        **field.summarise(),
        "dataset/name": predictor.site.name,
        "dataset/kind": predictor.site.kind,
        "model/name": predictor.method.name,
        "ckpt": config.ckpt,
        "promise/share": how.share,
        "promise/calibrated": int(promise is not None),
        **peak_memory(),
    }
    if coverage is not None and promise is not None and ends is not None:
        reach = promise.calibration(how.share).reach
        facts |= {f"promise/held/{name}": value for name, value in vars(coverage).items()}
        facts |= {"map/covered_low": ends[0], "map/covered_high": ends[1]}
        facts |= {"promise/reach_m": reach, "promise/block_m": promise.block_m}
    before = f"{facts['map/cells']} squares, {facts['map/stations']} station(s)"
    if field.calibrated:
        before += f", expected error {facts['map/expected_error_db']:.2f} dB of the strongest"
    return Result(facts, (), lines, f"{before}; map ")
