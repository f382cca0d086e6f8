"""`gsparc serve ckpt=FILE`: a model's answers over HTTP."""

from __future__ import annotations

import ipaddress
import os
from importlib.util import find_spec

from omegaconf import DictConfig

from gsparc.commands.shared.settings import RunSettings
from gsparc.data.errors import DataError
from gsparc.data.limits import SettingError, number, whole
from gsparc.evaluation.console import open_console
from gsparc.prediction.operating_point import load

STOP_S = 10  # that requests under way have to end


def loopback(host: str) -> bool:
    """Whether nobody else reaches it."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def task(config: DictConfig) -> None:
    """Serve until Ctrl-C or SIGTERM; requests under way are answered."""
    RunSettings.of(config)
    whole(1).check("most", config.most)
    whole(0, 65535).check("port", config.port)
    number(0, 1000).check("delay_ms", config.delay_ms)
    token = config.token or os.environ.get("GSPARC_TOKEN")
    if not token and not loopback(config.host):
        raise SettingError(f"host={config.host}: others reach it; set GSPARC_TOKEN, or say token=WORD")
    if find_spec("fastapi") is None or find_spec("uvicorn") is None:
        raise DataError("gsparc serve needs the extra `serve`: pip install 'gsparc[serve]'")
    import uvicorn

    from gsparc.prediction.serving import application

    predictor = load(config.ckpt, unit=config.unit)
    predictor = predictor if config.station is None else predictor.at(config.station)
    if predictor.site.static_end is None or (predictor.site.stations and predictor.site.kind != "rssi"):
        raise DataError("serve: one end that stands still is needed; of several stations say station=NAME")
    app = application(predictor, config.delay_ms / 1e3, config.most, token)
    open_console().print(f"{predictor} at http://{config.host}:{config.port}", highlight=False, markup=False)
    uvicorn.run(
        app, host=config.host, port=config.port, log_level="warning", timeout_graceful_shutdown=STOP_S
    )
