"""Localisation by every trained method of a comparison, beside plain ones."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import pandas as pd
from omegaconf import DictConfig
from rich.table import Table

from gsparc.evaluation.console import one_line
from gsparc.evaluation.experiment.done import State, once
from gsparc.evaluation.experiment.fitting import Filled
from gsparc.evaluation.summary import table

log = logging.getLogger(__name__)

NAMES = ["dataset", "split", "method"]
FIGURES = ["median_m", "p90_m", "held", "locate_ms"]
Locate = Callable[[DictConfig, Path], dict[str, Any]]


def compare_places(
    filled: Sequence[Filled], settings: Mapping[str, Any], cells_dir: Path, locate: Locate
) -> pd.DataFrame:
    """Locate with every kept model that states a variance, and by the nearest rows of sets of fingerprints.

    A localisation is kept beside its cell. Of several draws and folds the first is located.

    Args:
        filled: cells; those without a checkpoint are left out.
        settings: files of `fingerprints` by name, their `splits`, and overrides of `gsparc locate`.
        cells_dir: of kept cells.
        locate: locates as conf/locate.yaml says, into a folder, and returns its facts.

    Returns:
        A row per method and split, the best first: `NAMES`, errors [m], the share of places that areas hold
        (`held`) and milliseconds of a snapshot; NaN where a method has none.

    Raises:
        ValueError: nothing could be located.
    """
    own = {name: value for name, value in settings.items() if name not in ("fingerprints", "splits")}
    # Cells of several seeds and draws follow one another: of each method the first that works is located.
    jobs: list[tuple[tuple[str, str, str], Path, dict[str, Any]]] = [
        ((one.cell.dataset, one.cell.split, one.cell.method), one.folder, {"ckpt": str(one.checkpoint)})
        for one in filled
        if one.checkpoint.is_file()
    ]
    # Fingerprints have no cell: `gsparc locate` itself learns from their rows.
    for name, file in settings["fingerprints"].items():
        for split in settings["splits"]:
            chosen = {"dataset": "fingerprints", "dataset.file": file, "dataset.split": split}
            jobs.append(((name, split, "weighted_knn"), cells_dir / name / split / "weighted_knn", chosen))
    rows, done = list[dict[str, Any]](), set[tuple[str, str, str]]()
    for names, folder, chosen in jobs:
        if names in done:
            continue
        try:
            # store=false: the model belongs to the cell and is not to be changed by what is asked of it.
            facts = _facts(folder, {**chosen, **own, "store": False}, locate)
        except ValueError as error:
            log.warning("%s cannot be located, no row of it: %s", "/".join(names), one_line(error))
            continue
        rows += _rows(names, facts)
        done.add(names)
    if not rows:
        raise ValueError("task=locate: no cell keeps a model that states a variance")
    # Plain methods come beside every model: the first of each stays.
    errors = pd.DataFrame(rows, columns=[*NAMES, *FIGURES]).drop_duplicates(NAMES)
    return errors.sort_values(["dataset", "split", "median_m"], ignore_index=True)


def facts_and_table(errors: pd.DataFrame) -> tuple[dict[str, Any], Table]:
    """`<dataset>/<split>/<method>/<figure>` of what `compare_places` found, and a table for a terminal."""
    facts, lines = dict[str, Any](), []
    for row in errors.astype(object).where(errors.notna(), None).to_dict("records"):
        names = [row[name] for name in NAMES]
        facts |= {f"{'/'.join(names)}/{name}": row[name] for name in FIGURES}
        lines.append([*names, *("" if row[name] is None else f"{row[name]:.3g}" for name in FIGURES)])
    heads = ["data", "split", "method"], ["median [m]", "p90 [m]", "held", "ms"]
    return facts, table("localisation", *heads, lines)


def _facts(folder: Path, choices: Mapping[str, Any], locate: Locate) -> dict[str, Any]:
    """Of one localisation, which is done once."""
    overrides = [f"{name}={_quoted(value)}" for name, value in choices.items()]
    config, here = hydra.compose("locate", [*overrides, "hydra.run.dir=."]), folder / "locate"
    return once(here, State.of(config), lambda left: locate(config, here))


def _rows(names: tuple[str, str, str], facts: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    stems = [name.removesuffix("/median_m") for name in facts if name.endswith("/median_m")]
    for stem in stems:
        row = {**dict(zip(NAMES, names, strict=True)), "median_m": facts[f"{stem}/median_m"]}
        row["p90_m"] = facts[f"{stem}/p90_m"]
        if stem == "locate":
            yield {**row, "held": facts["locate/coverage"], "locate_ms": facts["time/locate_ms_p50"]}
        else:
            plain = stem.removeprefix("baseline/")
            yield {**row, "method": plain, "locate_ms": facts.get(f"{stem}/locate_ms")}


def _quoted(value: Any) -> str:
    # Hydra's grammar: text in quotes may hold = and commas; numbers and lists must not be quoted.
    return f"'{value}'" if isinstance(value, str) else str(value).replace("'", "").replace("None", "null")
