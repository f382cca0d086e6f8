"""`gsparc export ckpt=FILE to=c`: a trained model for programs without Python and for emulators."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

import gsparc.ops
from gsparc.commands.output import finish, run_directory
from gsparc.commands.predict.placing import in_world, with_heights
from gsparc.commands.settings import RunSettings
from gsparc.data.files import whole_folder
from gsparc.data.limits import POSITIVE, SettingError, choice, or_null, whole
from gsparc.data.query_places import read_query_places, read_times
from gsparc.data.raw import Raw, write_raw
from gsparc.data.schema import Site
from gsparc.prediction.along import deepmimo, emulators
from gsparc.prediction.along.taps import Trajectory, fitted
from gsparc.prediction.compiled.blob import write
from gsparc.prediction.compiled.make import compiled
from gsparc.prediction.operating_point import load
from gsparc.prediction.predictor import Predictor

SOURCES = Path(gsparc.ops.__file__).parent / "csrc"
SLOT_S = 1e-3  # of 15 kHz between subcarriers
Facts = tuple[dict[str, Any], list[str]]


def task(config: DictConfig) -> dict[str, Any]:
    """Export, and say what is lost; returns the facts of `summary.json`."""
    RunSettings.of(config)
    whole(1).check("symbols", config.symbols)
    if config.check is not None:
        return _checked(Path(config.check), config.symbols)
    choice(*WRITERS).check("to", config.to)
    choice("npz", "h5").check("file", config.file)
    for name in ("places", "taps", "antennas"):
        whole(1).check(name, config[name])
    for name in ("rate_hz", "snapshot_s", "spacing_khz"):
        or_null(POSITIVE).check(name, config[name])
    path = Path(config.ckpt)
    out = path.with_name(f"{path.stem}-{config.to}") if config.out is None else Path(config.out)
    if out.exists():
        raise SettingError(f"out={out}: is there already; remove it or name another folder")
    predictor = load(path)
    predictor = predictor if config.station is None else predictor.at(config.station)
    with whole_folder(out) as folder:
        facts, lines = WRITERS[config.to](predictor, config, folder, out)
    facts |= {"model/name": predictor.method.name, "out": str(out), "ckpt": str(path)}
    return finish(run_directory(), facts, lines=lines, before="summary ")


def _library(predictor: Predictor, config: DictConfig, folder: Path, out: Path) -> Facts:
    found = compiled(predictor, int(config.places))
    size = write(folder / "field.gsparc", found.form, np.asarray(predictor.site.origin), found.error)
    shutil.copy(SOURCES / "field" / "gsparc_field.h", folder)
    shutil.copytree(
        SOURCES, folder / "source", ignore=shutil.ignore_patterns("cuda", "projection", "bindings.cpp")
    )
    facts = {"export/bytes": size, "export/error": found.error, "export/form": found.form.kind}
    build = f"cmake -S {out}/source/field -B {out}/build && cmake --build {out}/build"
    return facts, [found.said, f"{size / 1e6:.2f} MB in {out}/field.gsparc; the library: {build}"]


def _places(site: Site, config: DictConfig) -> np.ndarray:
    """World places (n, 3) [m] of the moving end in `config.table`."""
    queries = with_heights(
        read_query_places(config.table or _needed("table", config), (site.moving_end,)), site
    )
    return in_world(queries, site)[site.moving_end]


def _impulses(predictor: Predictor, config: DictConfig, folder: Path, out: Path) -> Facts:
    site, time_s = predictor.site, read_times(config.table or _needed("table", config))
    if time_s is None:
        raise SettingError(f"table={config.table}: no column time_s [s]")
    way = Trajectory(time_s, _places(site, config))
    line = fitted(predictor, way, config.taps, config.rate_hz, config.antennas)
    units = {"time_s": "s", f"{site.moving_end}_position": "m", "delay_s": "s", "doppler_hz": "Hz"}
    delay_s = (line.first + np.arange(line.gain.shape[2])) / line.rate_hz
    known = (line.time_s, way.at(line.time_s), delay_s, line.doppler_hz())
    arrays = dict(zip(units, known, strict=True)) | {"gain": line.gain}
    if line.paths is not None:
        arrays |= {"path_gain": line.paths.gain, "path_delay_s": line.paths.delay_s}
        arrays["path_doppler_hz"] = line.path_doppler_hz()
    about = {"rate_hz": line.rate_hz, "carrier_hz": line.carrier_hz, "residual": line.residual}
    write_raw(folder / f"cir.{config.file}", Raw(arrays, about, units))
    facts = {
        "cir/residual_db": _db(line.residual),
        "cir/worst_db": _db(line.worst),
        "cir/early_s": delay_s[0],
    }
    said = (
        "{} taps at {:g} MHz leave {:.1f} dB of the channels ({:.1f} at worst) in {}/cir.{}; first {:.1f} ns"
    )
    lines = [said.format(line.gain.shape[2], line.rate_hz / 1e6, facts["cir/residual_db"],
                         facts["cir/worst_db"], out, config.file, delay_s[0] * 1e9)]  # fmt: skip
    if config.to == "cir":
        short = fitted(predictor, way, min(config.taps, emulators.PUBLISHED), line.rate_hz, config.antennas)
        symbol_s = SLOT_S * 15 / config.spacing_khz / config.symbols
        count = emulators.write_sionna_rk(folder / "sionna-rk", line, symbol_s, config.symbols)
        speed, step_s = way.fastest, float(config.snapshot_s)
        scale = emulators.write_vrtsim(folder / "vrtsim", short, step_s, site.moving_end, speed)
        facts |= {"cir/symbols": count, "cir/vrtsim_scale": scale, "cir/vrtsim_db": _db(short.residual)}
        lines.append(f"{count} OFDM symbols in sionna-rk; vrtsim with {_db(short.residual):.1f} dB")
    return facts, lines


def _db(ratio: float) -> float:
    return float(10 * np.log10(max(ratio, 1e-30)))


def _needed(name: str, config: DictConfig) -> str:
    raise SettingError(f"{name}=null: to={config.to} needs a file of places")


def _scenario(predictor: Predictor, config: DictConfig, folder: Path, out: Path) -> Facts:
    place = _places(predictor.site, config)
    paths, left_out = deepmimo.write(folder, predictor, place)
    facts = {"deepmimo/places": len(place), "deepmimo/paths": paths, "deepmimo/left_out": left_out}
    return facts, [
        f"{len(place)} places, at most {paths} paths; beyond these {left_out:.2g} of the power: {out}"
    ]


def _checked(path: Path, symbols: int) -> dict[str, Any]:
    found = emulators.check(path, symbols)
    if found.refused:
        raise SettingError(f"check={path}: {found.holds}, but {'; '.join(found.refused)}")
    lines = [f"{path}: {found.holds}; a reader takes all of it"]
    return finish(run_directory(), {"check/holds": found.holds}, lines=lines, before="summary ")


WRITERS = {"c": _library, "cir": _impulses, "sionna": _impulses, "deepmimo": _scenario}
