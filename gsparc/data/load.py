"""From the config groups `dataset` and `split` to `Measurements` and `Split`."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from gsparc.data.errors import DataError
from gsparc.data.rfid import WAVELENGTH, describe_missing, load_rfid, planar_array
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split, SplitSettings, make_split, read_split

log = logging.getLogger(__name__)


def load(config: Mapping[str, Any]) -> Measurements:
    """Load what the config group `dataset` names.

    Args:
        config: keys as in conf/dataset/*.yaml; `name` chooses the loader.

    Raises:
        DataError: unknown name, missing file, or bad input.
    """
    name = str(config.get("name"))
    if name not in LOADERS:
        close = difflib.get_close_matches(name, LOADERS, n=1, cutoff=0.4)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise DataError(f"dataset: {name!r} is none of {', '.join(LOADERS)}{hint}")
    wrong = "file" if name in FOLDERS else "root"
    if config.get(wrong) is not None:
        right = "root" if name in FOLDERS else "file"
        raise DataError(f"dataset.{wrong} is not a setting of dataset={name}; say dataset.{right}=...")
    return LOADERS[name](config)


def split_for(config: Mapping[str, Any], data: Measurements) -> Split:
    """Split `data` as the config group `split` says; `name: file` reads an index file.

    Raises:
        DataError: unknown name or key, impossible shares, or a file made for other data.
    """
    if config.get("name") == "file":
        return read_split(config["path"], len(data), data.site.sha256)
    known = {field.name for field in fields(SplitSettings)}
    unknown = [key for key in config if key not in known]
    if unknown:
        raise DataError(f"split.{unknown[0]}: no such setting; there are {', '.join(sorted(known))}")
    return make_split(data.moving, SplitSettings(**dict(config)), data.release_split)


def _rfid(config: Mapping[str, Any]) -> Measurements:
    root = config.get("root")
    if root is None or not Path(root).exists():
        stand_in = config.get("stand_in") or {}
        log.warning("%s Using the SIMULATED stand-in rfid-sim instead.", describe_missing(root))
        return _rfid_sim(stand_in)
    array = config.get("array")
    return load_rfid(
        root,
        gateway=config.get("gateway"),
        wavelength_m=float(config.get("wavelength_m", WAVELENGTH)),
        array=planar_array(**array) if array else None,
        normalisation=str(config.get("normalisation", "max")),
    )


def _rfid_sim(config: Mapping[str, Any]) -> Measurements:
    from gsparc.simulate.rfid_sim import ensure_rfid_sim

    folder = ensure_rfid_sim(
        Path(config.get("root", "outputs/stand-ins")),
        count=int(config.get("count", 640)),
        seed=int(config.get("seed", 0)),
    )
    log.warning("rfid-sim: SIMULATED data in the layout of the RFID release, at %s", folder)
    return load_rfid(folder)


def _required_file(config: Mapping[str, Any]) -> Path:
    file = config.get("file")
    if not file:
        raise DataError(f"dataset.file is not set; say dataset.file=FILE for dataset={config.get('name')}")
    return Path(file)


def _newrf(config: Mapping[str, Any]) -> Measurements:
    from gsparc.data.newrf import load_newrf

    return load_newrf(_required_file(config))


def _own(config: Mapping[str, Any]) -> Measurements:
    from gsparc.data.describe import suspicious_values
    from gsparc.data.own import load_own

    file = _required_file(config)
    data = load_own(file)
    for doubt in suspicious_values(data):
        log.warning("%s: units? %s", file, doubt)
    return data


def _argos(config: Mapping[str, Any]) -> Measurements:
    from gsparc.data.argos import describe_missing as describe_missing_argos

    root = config.get("root")
    if root is None or not Path(root).exists():
        log.warning("%s Using the SIMULATED stand-in argos-sim instead.", describe_missing_argos(root))
        return _argos_sim(config)
    return _argos_folder(Path(root), config)


def _argos_sim(config: Mapping[str, Any]) -> Measurements:
    from gsparc.simulate.argos_sim import SCATTERERS, ensure_argos_sim

    stand_in = config.get("stand_in") or {}
    folder = ensure_argos_sim(
        Path(stand_in.get("root", "outputs/stand-ins")),
        count=int(stand_in.get("count", 4000)),
        seed=int(stand_in.get("seed", 0)),
        offsets=bool(stand_in.get("offsets", True)),
        scatterers=int(stand_in.get("scatterers", SCATTERERS)),
    )
    log.warning("argos-sim: SIMULATED data in the layout of the Argos release, at %s", folder)
    return _argos_folder(folder, config)


def _argos_folder(folder: Path, config: Mapping[str, Any]) -> Measurements:
    from gsparc.data.argos import load_argos
    from gsparc.data.position_encoder.autoencoder import EncoderSettings
    from gsparc.data.position_encoder.store import encoder_for

    given = dict(config.get("encoder") or {})
    file, room = given.pop("file", None), Path(given.pop("folder", "outputs/encoders"))
    return load_argos(
        folder,
        encoder_for(room, EncoderSettings(**given), file),
        antenna=config.get("antenna", 0),
        positions=str(config.get("positions", "encoder")).lower(),  # `true` in YAML is no text
        align=bool(config.get("align", True)),
    )


def _sionna(config: Mapping[str, Any]) -> Measurements:
    from gsparc.data.sionna import load_sionna

    return load_sionna(_required_file(config), config.get("target"), config.get("truth"))


FOLDERS = ("rfid", "rfid_sim", "argos", "argos_sim")  # datasets that are a folder; the others are one file

LOADERS: dict[str, Callable[[Mapping[str, Any]], Measurements]] = {
    "rfid": _rfid,
    "rfid_sim": _rfid_sim,
    "argos": _argos,
    "argos_sim": _argos_sim,
    "newrf": _newrf,
    "own": _own,
    "sionna": _sionna,
}
