"""`gsparc locate ckpt=FILE`: where its test rows, or the rows of another file, were heard."""

from __future__ import annotations

from gsparc.apps.locate.judging import locate_by_model, locate_fingerprints
from gsparc.apps.locate.neighbours import PLAIN
from gsparc.apps.maps.area import read_plan_settings
from gsparc.base.limits import (
    POSITIVE,
    SHARE,
    choice,
    number,
    or_null,
    switch,
    whole,
)
from gsparc.runs.output import CommandCall, Result, command

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


@command(**LIMITS)
def task(call: CommandCall) -> Result:
    """Locate rows, as conf/locate.yaml says."""
    config = call.config
    for name in config.against:
        choice(*PLAIN).check("against", name)
    if config.dataset.name == "fingerprints":
        return Result(*locate_fingerprints(config, call.folder))
    plan = read_plan_settings(call.given)
    return Result(*locate_by_model(config, call.folder, None if plan is None else plan.is_open))
