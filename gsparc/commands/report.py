"""`gsparc report RUN_DIR...`: runs side by side, one page that opens offline, CSV and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from gsparc.base.files import SUMMARY
from gsparc.evaluation.results import PROBLEM, frame, own_rows, read_columns, read_summary
from gsparc.pictures.drawing import PRINTED
from gsparc.pictures.report.page import write_report
from gsparc.runs.experiment.runner import time_again
from gsparc.runs.output import CommandCall, Result, command


@command()
def task(call: CommandCall) -> Result:
    """Write one page about runs."""
    config = call.config
    if OmegaConf.is_missing(config, "runs"):
        raise ValueError(
            "no run is named; say gsparc report RUN..., folders of runs or of whole sweeps"
        )
    for form in config.figures:
        PRINTED.check("figures", form)
    paths = [Path(path) for path in config.runs]
    rows = frame(*paths)
    # Times of other days and machines do not compare: every model is asked anew, here.
    if config.retime:
        rows = time_again(rows, rounds=int(config.rounds), rounds_s=float(config.rounds_s))
    write_report(call.folder, config.title, rows, _fronts(paths), config.figures)
    count, studies = len(own_rows(rows)), rows.groupby(PROBLEM, dropna=False).ngroups
    facts = {"report/runs": count, "report/studies": studies}
    return Result(facts, before=f"{count} run{'s' * (count > 1)}; report.html ")


def _fronts(paths: Sequence[Path]) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Swept fronts in and below the directories, with the names of their datasets."""
    # Sorted, as the order of a file system differs from machine to machine.
    files = [file for path in paths for file in sorted(path.rglob("tradeoff.csv"))]
    facts = (read_summary(file.parent / SUMMARY) or {} for file in files)
    return [
        (str(of.get("dataset/name")), read_columns(file))
        for of, file in zip(facts, files, strict=True)
    ]
