"""`gsparc compare task=locate`: where test rows were heard, by every trained method beside plain ones."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import hydra

from gsparc.commands.locate import locate
from gsparc.commands.output import columns, finish
from gsparc.evaluation.console import one_line
from gsparc.evaluation.experiment.fitting import Filled
from gsparc.evaluation.experiment.problem import facts_of
from gsparc.evaluation.summary import provenance, table, write_samples

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """Errors [m] of one method on one split; `held` is the share of places inside their areas."""

    dataset: str
    split: str
    method: str
    median_m: float
    p90_m: float
    held: float | None
    locate_ms: float | None


def compare_places(
    filled: Sequence[Filled], settings: Mapping[str, Any], kept: Path, run_dir: Path
) -> list[Row]:
    """Locate with every kept model that states a variance, and with the field of every set of fingerprints.

    A localisation is kept beside its cell. Of several draws and folds the first is located.

    Args:
        filled: cells; those without a checkpoint are left out.
        settings: files of `fingerprints` by name, their `splits`, and overrides of `gsparc locate`.
        kept: folder of cells.
        run_dir: gets `places.csv` and `summary.json`.

    Raises:
        ValueError: nothing could be located.
    """
    own = {name: value for name, value in settings.items() if name not in ("fingerprints", "splits")}
    jobs: list[tuple[tuple[str, str, str], Path, dict[str, Any]]] = [
        ((one.cell.dataset, one.cell.split, one.cell.method), one.folder, {"ckpt": str(one.checkpoint)})
        for one in filled
        if one.checkpoint.is_file()
    ]
    for name, file in settings["fingerprints"].items():
        for split in settings["splits"]:
            chosen = {"dataset": "fingerprints", "dataset.file": file, "dataset.split": split}
            mark = sha256(Path(file).read_bytes()).hexdigest()[:20]
            jobs.append(((name, split, "field"), kept / f"{name}-{split}-field-{mark}", chosen))
    rows: dict[tuple[str, str, str], Row] = {}
    for (dataset, split, method), folder, chosen in jobs:
        try:
            facts = _facts(folder, {**chosen, **own, "store": False})
        except ValueError as error:
            log.warning("%s/%s/%s is not located: %s", dataset, split, method, one_line(error))
            continue
        for row in _rows(dataset, split, method, facts):
            rows.setdefault((dataset, split, row.method), row)
    if not rows:
        raise ValueError("task=locate: no cell keeps a model that states a variance")
    ordered = sorted(rows.values(), key=lambda row: (row.dataset, row.split, row.median_m))
    write_samples(run_dir / "places.csv", columns(ordered, Row))
    stated = {
        f"{row.dataset}/{row.split}/{row.method}/{name}": getattr(row, name)
        for row in ordered
        for name in ("median_m", "p90_m", "held", "locate_ms")
    }
    lines = [[row.dataset, row.split, row.method, *map(_number, _values(row))] for row in ordered]
    shown = table("localisation", ["data", "split", "method"], ["median [m]", "p90 [m]", "held", "ms"], lines)
    finish(run_dir, stated, shown)
    return ordered


def _facts(folder: Path, choices: Mapping[str, Any]) -> dict[str, Any]:
    """Of one localisation, which is done once by this commit of the program."""
    overrides = [f"{name}={_quoted(value)}" for name, value in choices.items()]
    here = folder / f"locate-{sha256(repr((provenance(), overrides)).encode()).hexdigest()[:12]}"
    stored = facts_of(here / "summary.json")
    if stored is None:
        here.mkdir(parents=True, exist_ok=True)
        stored = locate(hydra.compose("locate", [*overrides, "hydra.run.dir=."]), here)
    return stored


def _rows(dataset: str, split: str, method: str, facts: Mapping[str, Any]) -> Iterator[Row]:
    stems = [name.removesuffix("/median_m") for name in facts if name.endswith("/median_m")]
    for stem in stems:
        plain = stem.removeprefix("baseline/")
        ours = stem == "locate"
        yield Row(
            dataset, split, method if ours else plain, facts[f"{stem}/median_m"], facts[f"{stem}/p90_m"],
            facts["locate/coverage"] if ours else None,
            facts["time/locate_ms_p50"] if ours else facts.get(f"{stem}/locate_ms"),
        )  # fmt: skip


def _values(row: Row) -> tuple[float | None, ...]:
    return row.median_m, row.p90_m, row.held, row.locate_ms


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _quoted(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value).replace("'", "").replace("None", "null")
