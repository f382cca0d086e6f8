"""`gsparc export ckpt=FILE to=c`: a trained model for programs without Python
and link simulators.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import gsparc.ops
from gsparc.apps.export.along import deepmimo
from gsparc.apps.export.along.taps import Trajectory, write_taps
from gsparc.apps.export.compiled.blob import pack_form
from gsparc.apps.export.compiled.make import FIGURES, compile_model
from gsparc.base.files import whole_folder
from gsparc.base.limits import POSITIVE, SettingError, choice, or_null, whole
from gsparc.prediction.operating_point import load
from gsparc.prediction.placing import fill_heights, to_world
from gsparc.prediction.predictor import Predictor
from gsparc.runs.output import CommandCall, Result, command
from gsparc.tables.query_places import read_query_places, read_times

SOURCES = Path(gsparc.ops.__file__).parent / "csrc"
# Sources of GPU kernels, of projections and of the Python module are no part of the C library.
OTHERS = shutil.ignore_patterns("cuda", "projection", "bindings.cpp")
LIMITS = {name: whole(1) for name in ("places", "taps", "antennas")}
LIMITS |= {"rate_hz": or_null(POSITIVE)}
Facts = tuple[dict[str, Any], list[str]]


def _library(predictor: Predictor, given: Mapping[str, Any], folder: Path, out: Path) -> Facts:
    result = compile_model(predictor, given["places"])
    blob = pack_form(result.form, np.asarray(predictor.site.origin), result.error, result.worst)
    (folder / "field.gsparc").write_bytes(blob)
    shutil.copy(SOURCES / "field" / "gsparc_field.h", folder)
    shutil.copytree(SOURCES, folder / "source", ignore=OTHERS)
    facts: dict[str, Any] = {"export/bytes": len(blob), "export/form": result.form.kind}
    facts |= {"export/error": result.error}
    facts |= {"export/worst": result.worst, "export/figure": FIGURES[predictor.site.kind]}
    build = f"cmake -S {out}/source/field -B {out}/build && cmake --build {out}/build"
    return facts, [
        result.summary,
        f"{len(blob) / 1e6:.2f} MB in {out}/field.gsparc; the library: {build}",
    ]


def _places(predictor: Predictor, given: Mapping[str, Any]) -> np.ndarray:
    """World places (n, 3) [m] of the moving end in `table`."""
    if given["table"] is None:
        raise SettingError(f"table=null: to={given['to']} needs a file of places")
    site = predictor.site
    queries = fill_heights(read_query_places(given["table"], (site.moving_end,)), site)
    return to_world(queries, site)[site.moving_end]


def _impulses(predictor: Predictor, given: Mapping[str, Any], folder: Path, out: Path) -> Facts:
    # Taps sum tones with their phases, which rows of unknown factors do not have.
    predictor.site.need_phase("to=taps")
    place, time_s = _places(predictor, given), read_times(given["table"])
    if time_s is None:
        raise SettingError(f"table={given['table']}: no column time_s [s]")
    facts = write_taps(predictor, Trajectory(time_s, place), given, folder / "taps.npz")
    taps, rate_hz = facts.pop("taps/count"), facts.pop("taps/rate_hz")
    line = (
        f"{taps} taps at {rate_hz / 1e6:g} MHz leave {facts['taps/residual_db']:.1f} dB of the "
        "channels "
        f"({facts['taps/worst_db']:.1f} at worst) in {out}/taps.npz; "
        f"first {facts['taps/early_s'] * 1e9:.1f} ns"
    )
    return facts, [line]


def _scenario(predictor: Predictor, given: Mapping[str, Any], folder: Path, out: Path) -> Facts:
    place = _places(predictor, given)
    paths, rest = deepmimo.write_scenario(folder, predictor, place)
    facts = {"deepmimo/places": len(place), "deepmimo/paths": paths, "deepmimo/left_out": rest}
    return facts, [
        f"{len(place)} places, at most {paths} paths; beyond these {rest:.2g} of the power: {out}"
    ]


WRITERS = {"c": _library, "taps": _impulses, "deepmimo": _scenario}


@command(**LIMITS, to=choice(*WRITERS))
def task(call: CommandCall) -> Result:
    """Export, and say what is lost."""
    given, path = call.given, Path(call.given["ckpt"])
    out = Path(given["out"] or path.with_name(f"{path.stem}-{given['to']}"))
    # The files of an export belong together: none is written beside those of another one.
    if out.exists():
        raise SettingError(f"out={out}: is there already; remove it or name another folder")
    predictor = load(call.given["ckpt"]).select_station(given["station"])
    # The folder appears by renaming: an export that fails leaves nothing behind.
    with whole_folder(out) as folder:
        facts, lines = WRITERS[given["to"]](predictor, given, folder, out)
    facts |= {"model/name": predictor.method.name, "out": str(out), "ckpt": str(path)}
    return Result(facts, (), lines, "summary ")
