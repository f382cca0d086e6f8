"""Where a command writes, what it says at its end, and rows as columns of a file."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from rich.console import RenderableType

from gsparc.evaluation.console import open_console, repeated_warnings
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.timing import machine_facts


def run_directory() -> Path:
    """Return where the running command writes."""
    return Path(HydraConfig.get().runtime.output_dir)


def in_multirun() -> bool:
    """Tell whether the running command is a job of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def show_result(run_dir: Path, *tables: RenderableType, lines: Iterable[str] = (), before: str = "") -> None:
    """Show what a command ends with: tables, sentences, and `before` with where everything was written."""
    console = open_console()
    console.record = True
    for one in tables:
        console.print(one)
    # Hydra opens a log for every job; one without a line is not worth a word.
    log = "".join(f"; full log: {one.name}" for one in run_dir.glob("*.log") if one.stat().st_size)
    for line in (*repeated_warnings(), *lines, f"{before}written to {run_dir}{log}"):
        console.print(line, highlight=False)
    files = [one for one in logging.getLogger().handlers if isinstance(one, logging.FileHandler)]
    text = console.export_text().rstrip()
    for file in files:  # to the log's file alone: the console has it
        file.handle(logging.LogRecord(__name__, logging.INFO, __file__, 0, f"result:\n{text}", None, None))


def finish_run(
    run_dir: Path, facts: Mapping[str, Any], *tables: RenderableType, **how: Any
) -> dict[str, Any]:
    """Write `summary.json` with the program and the machine, then `show_result`; returns the facts.

    Of the machine, what `facts` says of it stands.
    """
    whole = {**machine_facts(), **facts, **provenance()}
    write_summary(run_dir / "summary.json", whole)
    show_result(run_dir, *tables, **how)
    return whole


def coordinates(places: np.ndarray, predictor: Predictor | None) -> dict[str, np.ndarray]:
    """Return columns of places (n, 3) [m], in degrees, too, where the model knows its place on Earth."""
    # Tenths of a millimetre here, about a millimetre in 1e-8 degrees.
    columns = dict(zip(("x", "y", "z"), places.T.round(4), strict=True))
    if predictor is not None and predictor.site.georeference is not None and len(places):
        latitude, longitude, _ = predictor.degrees(places)
        columns |= {"latitude": latitude.round(8), "longitude": longitude.round(8)}
    return columns
