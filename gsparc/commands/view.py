"""`gsparc view ckpt=FILE`: the field in three dimensions, in a browser or saved."""

from __future__ import annotations

import logging
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from gsparc.apps.maps.area import read_plan_settings
from gsparc.apps.view.building import cloud_colours, model_gaussians, open_model
from gsparc.apps.view.ply import write_ply
from gsparc.apps.view.site_view import SiteView, lay_power_plane
from gsparc.base.errors import DataError
from gsparc.base.files import write_whole
from gsparc.base.limits import whole
from gsparc.prediction.query import read_place
from gsparc.prediction.timing import peak_memory
from gsparc.runs.output import CommandCall, Result, command

log = logging.getLogger(__name__)

SAVED = (".html", ".ply")


@command(port=whole(0, 65535))
def task(call: CommandCall) -> Result:
    """Serve until Ctrl-C, or write what `save` names."""
    config, save = call.config, None if call.config.save is None else Path(call.config.save)
    check(save)  # before model and data are read, which takes seconds
    view = view_of(call.given)
    end = serve(view, config.host, config.port) if save is None else write(view, save)
    viewed, site = view.viewed, view.viewed.site
    facts = {
        "dataset/name": site.name,
        "dataset/kind": site.kind,
        "model/name": viewed.predictor.method.name,
        "ckpt": config.ckpt,
        **peak_memory(),
    }
    return Result(facts, (), [*viewed.notes, end], "summary ")


def check(save: Path | None) -> None:
    """Refuse, with `DataError`, what cannot be done before anything is read."""
    if save is not None and save.suffix.lower() not in SAVED:
        raise DataError(f"save={save}: expected a name that ends with {', '.join(SAVED)}")
    # Pages are made of viser's client; splat files are not.
    if (save is None or save.suffix.lower() == ".html") and find_spec("viser") is None:
        raise DataError(
            "viewing in a browser needs viser: pip install 'gsparc[viewer]' (save=gaussians.ply "
            "does without)"
        )


def view_of(settings: dict[str, Any]) -> SiteView:
    """Return everything that is shown, by a configuration;
    `DataError` for a file or place that cannot be.
    """
    plan = read_plan_settings(settings)
    viewed = open_model(*(settings[name] for name in ("ckpt", "dataset", "station", "unit")))
    at, other = (
        None if settings[k] is None else read_place(k, settings[k]) for k in ("at", "other_end")
    )
    return SiteView(viewed, plan, lay_power_plane(viewed, settings, plan), at, other)


def serve(view: SiteView, host: str, port: int) -> str:
    """Serve until Ctrl-C; return what is said then."""
    # Imported here, as viser is an extra that splat files do without.
    from gsparc.apps.view.server.session import PageServer

    server = PageServer(view, host, port)
    log.info("open %s in a browser; Ctrl-C ends it", server.address)
    server.run()
    return f"{server.address} is closed"


def write(view: SiteView, path: Path) -> str:
    """Write a page or a splat file, whole or not at all; return what is said then."""
    if path.suffix.lower() == ".html":
        from gsparc.apps.view.server.page import render_page

        write_whole(path, render_page(view))
        return f"written to {path}"
    name = view.viewed.stations[0]
    cloud = model_gaussians(view.viewed, name, view.station(name).measured)
    if cloud is None:
        model = f"{view.viewed.predictor.method.name} of {view.viewed.site.name}"
        raise DataError(
            f"save={path}: {model} holds no Gaussians to write; save=FILE.html draws it"
        )
    write_ply(path, cloud, cloud_colours(cloud)[1])
    return f"{len(cloud)} Gaussians written to {path}"
