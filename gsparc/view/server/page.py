"""A scene as one HTML file that opens without a server, with a recorded walk of the end that moves."""

from __future__ import annotations

import contextlib
import html
import io
from typing import Any

import numpy as np
import viser

from gsparc.view.answer import Answer, ask
from gsparc.view.building import PATHS, SPHERE, rays_of
from gsparc.view.panel import panel_image
from gsparc.view.plane import refining, sheet
from gsparc.view.reasons import Usual
from gsparc.view.scene import EXTENT, Legend, Points, Scene, Sheet
from gsparc.view.server.draw import draw, first_view, floor
from gsparc.view.site_view import SiteView, walk
from gsparc.view.words import ENDS, headline, legend_html

STEPS = 24  # places of the walk
PAUSE_S = 0.6  # at each
UP = 0.17  # widths that the camera looks above the middle, for the panel that stands behind
LIMITS = (
    "A saved scene: nothing is computed here. Drag to turn it, scroll to come nearer; the bar at the bottom "
    "plays {steps} recorded places of the {end}. To drag it anywhere, to change the operating point or to "
    "lift the plane: gsparc view ckpt=FILE."
)


def page(view: SiteView, steps: int = STEPS) -> str:
    """The page as text; about 1 MB, most of it the viewer.

    Args:
        view: the model; its first station is shown.
        steps: places of the walk.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # viser's banner, of a server that nobody is to visit
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            text, notes = _recorded(server, view, steps)
        finally:
            server.stop()
    before, end, after = text.rpartition("</body>")
    return before + notes + end + after


def _recorded(server: Any, view: SiteView, steps: int) -> tuple[str, str]:
    name = view.viewed.stations[0]
    one, viewed, api = view.station(name), view.viewed, server.scene
    scene, moving = one.scene, viewed.moving[-1]
    api.set_up_direction("+z")
    first_view(server.initial_camera, 0.0, UP)
    for part in scene.parts:
        if part.name not in scene.hidden:
            draw(api, scene.frame, part)
    side = floor(api, scene)
    legends = [legend for part, legend in scene.legends.items() if part not in scene.hidden]
    if view.grid is not None:
        *_, plane = refining(viewed.asked(name), view.grid, _other(view))
        assert plane is not None
        legend = one.power or Legend.over(f"predicted power [{view.unit}]", plane.level_db)
        legends.append(legend)
        draw(api, scene.frame, sheet("plane", view.grid, plane.level_db, legend, one.dot / 2))
    places = walk(view, name, steps)
    answers = [ask(viewed.asked(name), {**view.starts(name), moving: place}) for place in places]
    recorder = server.get_scene_serializer()
    dot = api.add_icosphere("/end", radius=0.016 * EXTENT, color=(214, 39, 40))
    label = api.add_label("/end/says", "", position=(0, 0, 0.03 * EXTENT), anchor="bottom-center")
    sphere = view.sphere(name)
    for place, answer in zip(places, answers, strict=True):
        dot.position = scene.frame.drawn(place)
        label.text = headline(answer, view.unit)
        if sphere is not None and answer.spectrum is not None and "rx" in answer.ends:
            dots = Points(
                SPHERE, answer.ends["rx"] + sphere.offsets, sphere.colours(answer.spectrum), sphere.size
            )
            draw(api, scene.frame, dots)
        if (rays := rays_of(answer, view.extent(name))) is not None:
            legends = [*legends, PATHS] if PATHS not in legends else legends
            for part in rays:
                draw(api, scene.frame, part)
        draw(api, scene.frame, _upright(answer, view, one.about.usual, scene.frame.middle, view.extent(name)))
        recorder.insert_sleep(PAUSE_S)
    said = [*scene.notes, f"grid: {side:g} m", LIMITS.format(steps=len(places), end=ENDS[moving])]
    return recorder.as_html(), _side_panel(scene, said, legends)


def _other(view: SiteView) -> list[float] | None:
    if view.viewed.site.static_end is not None:
        return None
    return [float(value) for value in view.starts(None)["tx"]]


def _upright(answer: Answer, view: SiteView, known: Usual | None, middle: np.ndarray, extent: float) -> Sheet:
    """The panel of an answer, standing behind the site."""
    image = panel_image(answer, view.viewed.site, known, view.unit)
    wide = 1.05 * extent
    tall = wide * image.shape[0] / image.shape[1]
    corner = middle + np.array([-0.5 * wide, 0.8 * extent, 0.18 * extent + tall])
    return Sheet("panel", corner, np.array([wide, 0.0, 0.0]), np.array([0.0, 0.0, -tall]), image)


def _side_panel(scene: Scene, said: list[str], legends: list[Legend]) -> str:
    title = html.escape(scene.title)
    lines = "".join(f"<p style='margin:.3em .6em'>{html.escape(line)}</p>" for line in said)
    return (
        "<details open style='position:fixed;top:8px;left:8px;z-index:1000;width:250px;background:#fffe;"
        "border:1px solid #bbb;border-radius:6px;font:13px/1.35 system-ui,sans-serif;color:#222'>"
        f"<summary style='margin:.4em .6em;font-weight:600;cursor:pointer'>{title}</summary>"
        f"{legend_html(legends, scene.parts)}{lines}</details>"
    )
