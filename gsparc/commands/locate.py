"""`gsparc locate ckpt=FILE`: where its test rows, or the rows of another file, were heard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gsparc.apps.locate.fingerprints import locate_fingerprints
from gsparc.apps.locate.judging import locate_by_model
from gsparc.apps.locate.neighbours import PLAIN
from gsparc.apps.maps.floor_plan import read_plan_settings
from gsparc.base.limits import (
    POSITIVE,
    SHARE,
    check_arguments,
    choice,
    number,
    or_null,
    switch,
    whole,
)
from gsparc.runs.output import finish_run, run_directory
from gsparc.runs.settings import RunSettings, to_dict

LIMITS = {
    "prior": choice("box", "trained"),
    "share": SHARE,
    "offset_db": or_null(number(0)),
    "calibrate": whole(0),
    "calibrate_effort": or_null(POSITIVE),
    "rows": or_null(whole(1)),
    "phase_known": switch(),
    "renew": switch(),
}


def task(config: DictConfig) -> dict[str, Any]:
    """Locate rows; return the facts written to `summary.json` in the run directory."""
    return locate(config, run_directory())


def locate(config: DictConfig, run_dir: Path) -> dict[str, Any]:
    """Locate as conf/locate.yaml says, into a folder; returns the facts of its `summary.json`."""
    RunSettings.from_config(config)
    check_arguments(config, **LIMITS)
    for name in config.against:
        choice(*PLAIN).check("against", name)
    if config.dataset.name == "fingerprints":
        facts, tables, lines = locate_fingerprints(config, run_dir)
    else:
        plan = read_plan_settings(to_dict(config))
        facts, tables, lines = locate_by_model(
            config, run_dir, None if plan is None else plan.is_open
        )
    return finish_run(run_dir, facts, *tables, lines=lines)
