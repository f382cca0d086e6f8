"""A scene as one HTML file that opens without a server,
with a recorded walk of the end that moves.
"""

from __future__ import annotations

import contextlib
import html
import io
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import predict_answer
from gsparc.apps.view.building import PATHS, SPHERE, draw_rays
from gsparc.apps.view.reasons import legend_html, panel_image, summarise_answer
from gsparc.apps.view.scene import EXTENT, DrawnScene, Part, PlacedPicture, Points
from gsparc.apps.view.server.draw import draw_ground_grid, draw_scene, set_first_view
from gsparc.apps.view.site_view import SiteView, plane_sheet, walk_places
from gsparc.data.schema import ENDS

STEPS = 24  # places of the walk, of all stations together
LEAST = 4  # of each station
PAUSE_S = 0.6  # at each
UP = 0.17  # widths that the camera looks above the middle, for the panel that stands behind
LIMITS = (
    "A saved scene: nothing is computed here. Drag to turn it, scroll to come nearer; the bar at "
    "the bottom "
    "plays {steps} recorded places of the {end}{stations}. To drag it anywhere or to lift the "
    "plane: "
    "gsparc view ckpt=FILE."
)


def render_page(view: SiteView, steps: int = STEPS) -> str:
    """Return the page as text; about 1 MB, most of it the viewer.

    Args:
        view: the model; its stations are shown one after another, as many as get `LEAST` places.
        steps: places of the walk.
    """
    # viser's banner, of a server that nobody is to visit
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            text, notes = _recorded(server, view, steps)
        finally:
            server.stop()
    before, end, after = text.rpartition("</body>")
    return before + notes + end + after


def _recorded(server: Any, view: SiteView, steps: int) -> tuple[str, str]:
    viewed, api = view.viewed, server.scene
    names = viewed.stations[: max(steps // LEAST, 1)]
    api.set_up_direction("+z")
    set_first_view(server.initial_camera, 0.0, UP)
    scene, moving = view.station(names[0]).scene, viewed.moving[-1]
    side = draw_ground_grid(api, scene)
    nodes, legends = _still(api, view, names[0], {})
    recorder = server.get_scene_serializer()
    dot = api.add_icosphere("/end", radius=0.016 * EXTENT, color=(214, 39, 40))
    label = api.add_label("/end/says", "", position=(0, 0, 0.03 * EXTENT), anchor="bottom-center")
    count = 0
    for name in names:
        if name != names[0]:
            nodes, more = _still(api, view, name, nodes)
            legends += more
        sphere, extent = view.sphere(name), view.extent(name)
        for place in walk_places(view, name, steps // len(names)):
            answer = predict_answer(
                viewed.predictor_of(name), {**view.initial_places(name), moving: place}
            )
            dot.position = scene.frame.to_drawn(place)
            label.text = (f"{name}: " if len(names) > 1 else "") + summarise_answer(
                answer, view.unit
            )
            parts: list[Part] = list(draw_rays(answer, extent) or ())
            legends += [PATHS] if parts else []
            if sphere is not None and answer.spectrum is not None and "rx" in answer.ends:
                around = answer.ends["rx"] + sphere.offsets
                parts.append(Points(SPHERE, around, sphere.colours(answer.spectrum), sphere.size))
            image = panel_image(answer, viewed.site)
            parts += [] if image is None else [_upright(image, scene.frame.middle, extent)]
            nodes |= {part.name: part.draw(api, scene.frame) for part in parts}
            recorder.insert_sleep(PAUSE_S)
            count += 1
    which = ""
    if len(viewed.stations) > 1:
        which = (
            f", for {len(names)} of {len(viewed.stations)} stations ({', '.join(map(str, names))})"
        )
        some = len(names) < len(viewed.stations)
        which += "; station=NAME shows another" if some else ", one after another"
    notes = [
        *scene.notes,
        f"grid: {side:g} m",
        LIMITS.format(steps=count, end=ENDS[moving], stations=which),
    ]
    title = scene.title if len(names) == 1 else scene.title.removesuffix(f": {names[0]}")
    return recorder.as_html(), _side_panel(replace(scene, title=title), notes, legends)


def _still(
    api: Any, view: SiteView, name: str | None, before: dict[str, Any]
) -> tuple[dict[str, Any], list[Legend]]:
    """Draw what stands still of a station in place of the nodes `before`; its nodes,
    and their colours.
    """
    station = view.station(name)
    scene = station.scene
    nodes = draw_scene(api, scene, before)
    legends = list(scene.legends.values())
    if view.grid is not None:
        plane = view.plane(name, view.grid)
        legend = station.power or Legend.over(f"predicted power [{view.unit}]", plane.level_db)
        legends.append(legend)
        level = plane_sheet("plane", view.grid, plane.level_db, legend, station.dot / 2)
        nodes["plane"] = level.draw(api, scene.frame)
    if len(view.viewed.stations) > 1:
        legends = [replace(legend, label=f"{name}: {legend.label}") for legend in legends]
    return nodes, legends


def _upright(image: np.ndarray, middle: np.ndarray, extent: float) -> PlacedPicture:
    """The panel of an answer, standing behind the site."""
    wide = 1.05 * extent
    tall = wide * image.shape[0] / image.shape[1]
    corner = middle + np.array([-0.5 * wide, 0.8 * extent, 0.18 * extent + tall])
    return PlacedPicture(
        "panel", corner, np.array([wide, 0.0, 0.0]), np.array([0.0, 0.0, -tall]), image
    )


def _side_panel(scene: DrawnScene, notes: list[str], legends: list[Legend]) -> str:
    title = html.escape(scene.title)
    lines = "".join(f"<p style='margin:.3em .6em'>{html.escape(line)}</p>" for line in notes)
    return (
        "<details open "
        "style='position:fixed;top:8px;left:8px;z-index:1000;width:250px;background:#fffe;"
        "border:1px solid #bbb;border-radius:6px;font:13px/1.35 system-ui,sans-serif;color:#222'>"
        f"<summary style='margin:.4em .6em;font-weight:600;cursor:pointer'>{title}</summary>"
        f"{legend_html(legends, scene.parts)}{lines}</details>"
    )
