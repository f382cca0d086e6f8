"""`gsparc serve ckpt=FILE`: a model's answers over HTTP."""

from __future__ import annotations

import gc
import ipaddress
import os
from contextlib import suppress
from dataclasses import fields
from functools import partial
from importlib.util import find_spec

from gsparc.base.errors import DataError
from gsparc.base.limits import SettingError, whole
from gsparc.evaluation.console import open_console
from gsparc.models import checkpoint
from gsparc.prediction.operating_point import load
from gsparc.runs.output import CommandCall, command


def is_loopback(host: str) -> bool:
    """Tell whether a host is this machine itself, which nobody else reaches."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@command(port=whole(0, 65535))
def task(call: CommandCall) -> None:
    """Serve until Ctrl-C or SIGTERM; requests under way are answered."""
    config = call.config
    token = config.token or os.environ.get("GSPARC_TOKEN")
    # Without a token only this machine's own users may be answered.
    if not token and not is_loopback(config.host):
        raise SettingError(
            f"host={config.host}: others reach it; set GSPARC_TOKEN, or say token=WORD"
        )
    if find_spec("fastapi") is None or find_spec("uvicorn") is None:
        raise DataError("gsparc serve needs the extra `serve`: pip install 'gsparc[serve]'")
    from gsparc.apps.export.serving import Limits, build_application, make_server
    from gsparc.apps.export.told_file import ToldFile

    limits = Limits(**{field.name: config[field.name] for field in fields(Limits)})
    stored, as_stored = checkpoint.read(config.ckpt), partial(load, unit=config.unit)
    predictor = as_stored(stored).select_station(config.station)
    site, powers = predictor.site, predictor.site.target.is_level
    # Powers of all stations are one answer; channels and spectra are of one station each.
    if site.paired or (site.stations and not powers):
        raise DataError(
            "serve: one end that stands still is needed; of several stations say station=NAME"
        )
    told = ToldFile(stored, as_stored) if config.updates else None
    if told is not None and (config.station is not None or not powers):
        raise DataError("updates=true: is of powers, and of all stations of the model")
    app = build_application(predictor, limits, token, told)
    open_console().print(
        f"{predictor} at http://{config.host}:{config.port}", highlight=False, markup=False
    )
    gc.freeze()  # going through all that was loaded held up answers by half a second
    with suppress(KeyboardInterrupt):  # the server has ended by then
        make_server(app, limits, host=config.host, port=config.port).run()
