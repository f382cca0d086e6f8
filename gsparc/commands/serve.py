"""`gsparc serve ckpt=FILE`: a model's answers over HTTP."""

from __future__ import annotations

import gc
import ipaddress
import os
import socket
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch

from gsparc.base.errors import DataError
from gsparc.base.limits import SettingError, whole
from gsparc.evaluation.console import open_console
from gsparc.models import checkpoint
from gsparc.prediction.operating_point import load
from gsparc.prediction.predictor import Predictor
from gsparc.runs.output import CommandCall, command

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from gsparc.apps.export.serving import Limits

NEEDED = ("fastapi", "uvicorn", "prometheus_client")  # of the extra `serve`


def is_loopback(host: str) -> bool:
    """Tell whether a host is this machine itself, which nobody else reaches."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def take_port(host: str, port: int) -> socket.socket:
    """Return a socket at the port, which does not listen yet: nobody waits for a model to be read.

    Raises:
        DataError: another process listens there, or this machine has no such address.
    """
    # By its protocol asyncio knows that answers must not wait for more: 40 ms each.
    family, kind = socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM
    listening = socket.socket(family, kind, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        raise DataError(f"port={port} of host={host}: {error.strerror}; say another") from error
    return listening


def make_application(given: Mapping[str, Any], threads: int) -> tuple[Predictor, ASGIApp, Limits]:
    """Read the model, and return what answers for it, with so many threads.

    Args:
        given: settings of the command.
        threads: of torch.

    Raises:
        DataError: a model of what cannot be served.
    """
    # Of an extra, which the command says where it lacks.
    from gsparc.apps.export.serving import Limits, build_application
    from gsparc.apps.export.told_file import ToldFile

    torch.set_num_threads(threads)
    stored, as_stored = checkpoint.read(given["ckpt"]), partial(load, unit=given["unit"])
    predictor = as_stored(stored).select_station(given["station"])
    site, powers = predictor.site, predictor.site.target.is_level
    if site.paired:
        raise DataError("serve: one end that stands still is needed")
    update_file = ToldFile(stored, as_stored) if given["updates"] and powers else None
    accepts_pilots = given["updates"] and site.kind == "csi"
    if (
        given["updates"]
        and not accepts_pilots
        and (update_file is None or given["station"] is not None)
    ):
        raise DataError("updates=true: is of channels, or powers of all stations of the model")
    limits = Limits(**{field.name: given[field.name] for field in fields(Limits)})
    app = build_application(predictor, limits, given["token"], update_file, accepts_pilots)
    gc.freeze()  # going through all that was loaded held up answers by half a second
    return predictor, app, limits


def make_worker(given: Mapping[str, Any], threads: int) -> ASGIApp:
    """Return what answers in a process of its own."""
    return make_application(given, threads)[1]


@command(port=whole(0, 65535), workers=whole(1))
def task(call: CommandCall) -> None:
    """Serve until Ctrl-C or SIGTERM; requests under way are answered."""
    given = {**call.given, "token": call.given["token"] or os.environ.get("GSPARC_TOKEN")}
    host, workers = given["host"], given["workers"]
    # Without a token only this machine's own users may be answered.
    if not given["token"] and not is_loopback(host):
        raise SettingError(f"host={host}: others reach it; set GSPARC_TOKEN, or say token=WORD")
    if workers > 1 and given["updates"]:
        raise SettingError("workers=: with updates=true one process holds the model; say workers=1")
    if not all(map(find_spec, NEEDED)):
        raise DataError("gsparc serve needs the extra `serve`: pip install 'gsparc[serve]'")
    from uvicorn.supervisors import Multiprocess

    from gsparc.apps.export.serving import WORKERS, make_config, make_server

    with take_port(host, given["port"]) as listening:
        threads = max(torch.get_num_threads() // workers, 1)
        # Of several workers, too: it says what is wrong before they begin.
        predictor, app, limits = make_application(given, threads)
        place = f"http://{host}:{listening.getsockname()[1]}"
        open_console().print(f"{predictor} at {place}", highlight=False, markup=False)
        with suppress(KeyboardInterrupt), tempfile.TemporaryDirectory() as counts:
            if workers == 1:
                return make_server(app, limits).run([listening])
            os.environ[WORKERS] = counts
            make = partial(make_worker, given, threads)
            Multiprocess(
                make_config(make, limits, factory=True, workers=workers), [listening]
            ).run()
