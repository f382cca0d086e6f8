"""`gsparc check FILE_OR_FOLDER`: what was understood, or everything that is wrong."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from rich.console import Console

from gsparc.base.errors import Caution, DataError, Question, group_warnings

TILTED = (
    "antenna tilts are given, but no heights, so that all is at 0 m: give a column Height in the "
    "list of "
    "stations and dataset.columns.height=1.5 for places, or expect no more of the tilts than of "
    "azimuths"
)
UNUSED = ("_target_", "name", "batch_size", "align", "file")  # of conf/dataset/own.yaml, by check


def check(
    path: str,
    console: Console,
    columns: Mapping[str, str] | None = None,
    stations_file: str | None = None,
    draw: str | None = None,
    **settings: Any,
) -> bool:
    """Write what was understood of a file, or its problems one per line;
    returns whether it is good.

    Args:
        path, columns, stations_file, settings: see `read_any`.
        console: where lines go.
        draw: PNG file for a map; None draws none.
    """
    # Here: they bring torch, which --help does not need.
    import numpy as np

    from gsparc.data.outliers import outlier_warnings
    from gsparc.datasets.campaign import find_implausible
    from gsparc.datasets.describe import describe
    from gsparc.datasets.load import split_for
    from gsparc.datasets.own import read_any
    from gsparc.models.powers.together.network import check_azimuths
    from gsparc.prediction.foreseen import describe_few_rows
    from gsparc.tables.said_columns import write_columns

    try:
        # Read on with the likeliest of what is open, so that all that is open is said.
        table = {"columns": columns, "stations_file": stations_file, "guess": True}
        reading = read_any(path, **{**settings, **table})
    except DataError as error:
        count = len(error.problems)
        for line in [*error.problems, f"{path}: refused, {count} problem{'s' * (count > 1)}"]:
            _line(console, line)
        return False
    implausible, levels, steps = find_implausible(reading.data, reading.file_row, most=math.inf)
    stations, heights = reading.data.site.every_station, reading.data.moving[:, 2::3]
    # Where no azimuth is given there is none to contradict
    aimed = np.isfinite(stations.sector[:, 0]).any() if stations.sector is not None else False
    notes = [*reading.notes, *(check_azimuths(reading.data) if aimed else ())]
    questions = [note for note in notes if isinstance(note, Question)]
    doubtful = [note for note in notes if isinstance(note, Caution) and note not in questions]
    warnings = outlier_warnings(reading.data) + doubtful + implausible
    topics = describe(reading.data)
    if reading.raw is not None and reading.raw.roles:
        topics += [("columns", write_columns(path, reading.raw.roles, reading.raw.heads))]
    topics += [("note", note) for note in notes if not isinstance(note, Caution)]
    if not questions and (few := describe_few_rows(reading.data)) is not None:
        topics += [("few rows", few)]
    if any(" row " in warning for warning in warnings):
        topics += [("rows", "are counted from 0, as by split.leave_out and dataset.level_steps")]
    if (abs(stations.beams[:, 1]) > 0).any():
        # Of beams that point down nothing is known where both ends are at one height.
        warnings += [] if stations.position[:, 2].any() or heights.any() else [TILTED]
    doubts = group_warnings(warnings)
    guessed = bool(settings.get("guess"))
    open_roles = [("guessed" if guessed else "asked", question) for question in questions]
    for topic, sentence in [*open_roles, *topics, *(("warning", doubt) for doubt in doubts)]:
        _line(console, f"{topic:<12}{sentence}")
    if draw is not None:
        from gsparc.pictures.site_plan import draw_site  # here: only a map needs it

        try:
            draw_site(reading.data, Path(draw), levels, steps)
        except OSError as error:
            _line(console, f"{draw}: cannot be written ({error.strerror or error})")
            return False
        _line(console, f"{'drawn':<12}{draw}")
    try:
        # The random split needs the fewest rows: where it cannot be drawn, no other one can.
        split_for({"name": "random"}, reading.data).check()
    except DataError as error:
        _line(console, f"{path}: readable, but too small to train on ({error})")
        return False
    if questions and not guessed:
        number = f"{len(questions)} question{'s' if len(questions) > 1 else ''}"
        answer = "say one of each, or dataset.guess=true, which takes the first"
        _line(console, f"{path}: {number}, on which training stops: {answer}")
        return False
    verdict = (
        (f"readable, but see its {len(doubts)} warning{'s' * (len(doubts) > 1)}")
        if doubts
        else "good"
    )
    _line(console, f"{path}: {verdict}")
    return True


def _line(console: Console, text: str) -> None:
    text = text.encode("utf-8", "replace").decode()  # a path may not be UTF-8, and hold brackets
    console.print(text, markup=False, highlight=False, soft_wrap=True, emoji=False)


def read_settings(words: Sequence[str]) -> dict[str, Any]:
    """Return the settings of conf/dataset/own.yaml with `words` like dataset.absent=silent,
    as training does.

    Raises:
        HydraException, OmegaConfBaseException: what cannot be read, or no such setting.
    """
    import hydra  # here: a second that --help does without
    from omegaconf import OmegaConf

    with hydra.initialize_config_module("gsparc.conf", version_base="1.3"):
        node = hydra.compose("dataset/own", overrides=["dataset.file=", *words]).dataset
    settings: dict[str, Any] = OmegaConf.to_container(node, resolve=True)  # type: ignore[assignment]
    return settings


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; exit status 0 when everything given is good, else 1."""
    own = files("gsparc.conf").joinpath("dataset/own.yaml").read_text(encoding="utf-8")
    epilog = (
        f"settings dataset.KEY=VALUE, as training takes them:\n\n{own[own.index('stations: ') :]}"
    )
    parser = argparse.ArgumentParser(
        prog="gsparc check",
        description=__doc__,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    kinds = (
        "npz or HDF5 file, a table (csv, parquet), a campaign's file, or a folder like the "
        "RFID release"
    )
    add("path", nargs="+", metavar="FILE|dataset.KEY=VALUE", help=kinds)
    add("--stations-file", help="of a table: a second one that lists the stations")
    add("--draw", metavar="FILE.png", help="where the map goes; else to outputs/check")
    add("--no-draw", action="store_true", help="no map of places, levels and what looks wrong")
    args = parser.parse_intermixed_args(arguments)
    words = [word for word in args.path if word.startswith("dataset.") and "=" in word]
    paths = [path for path in args.path if path not in words]
    settings: dict[str, Any] = {"stations_file": args.stations_file}
    if words:  # as refusals and notes say them
        from hydra.errors import HydraException
        from omegaconf.errors import OmegaConfBaseException

        from gsparc.evaluation.console import error_in_one_line

        try:
            dataset_settings = read_settings(words)
        except (HydraException, OmegaConfBaseException) as error:
            _line(Console(stderr=True), f"error: {error_in_one_line(error)}")
            return 1
        paths += [dataset_settings["file"]] if dataset_settings["file"] else []
        dataset_settings["stations_file"] = dataset_settings["stations_file"] or args.stations_file
        settings = {name: value for name, value in dataset_settings.items() if name not in UNUSED}
    if not paths:
        parser.error("name a file or a folder, too")
    if args.draw is not None and (len(paths) > 1 or not args.draw.lower().endswith(".png")):
        parser.error(
            "--draw takes the name of a PNG file, and goes with one file; --no-draw draws none"
        )
    console = Console()

    def picture(number: int) -> str | None:
        stems = [Path(path).resolve().stem for path in paths[: number + 1]]
        again = stems.count(stems[-1])  # files of one stem would be drawn over one another
        name = f"{stems[-1]}-{again}" if again > 1 else stems[-1]
        return None if args.no_draw else args.draw or f"outputs/check/{name}.png"

    good = [
        check(path, console, draw=picture(number), **settings) for number, path in enumerate(paths)
    ]
    return 0 if all(good) else 1
