"""Parts of a scene as nodes of `viser`, in drawn units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gsparc.apps.view.scene import EXTENT, Faces, Frame, Lines, Mark, Part, Points, Scene, Sheet

THICKNESS = 1.5  # of lines [pixels]
STATION = (40, 40, 40)
ABOVE = (0.15, -0.95, 0.8)  # where a camera first stands, in widths of the site
ASIDE = 0.15  # how far east of the site it looks, where a panel covers what lies there


def draw(api: Any, frame: Frame, part: Part) -> Any:
    """Add a part under its name, in place of the one that had it; returns viser's handle."""
    name = path_of(part.name)
    if isinstance(part, Points):
        return api.add_point_cloud(
            name, frame.drawn(part.places), part.colours, point_size=part.size * frame.scale,
            point_shape="circle", precision="float32", point_shading="flat",
        )  # fmt: skip
    if isinstance(part, Lines):
        places, colours = frame.drawn(part.segments), np.repeat(part.colours[:, None], 2, axis=1)
        return api.add_line_segments(name, places, colours, thickness=THICKNESS, thickness_units="screen")
    if isinstance(part, Faces):
        return api.add_mesh_simple(
            name, frame.drawn(part.vertices), part.triangles, color=part.colour, opacity=part.opacity,
            side="double", flat_shading=True, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
    if isinstance(part, Sheet):
        return _sheet(api, frame, part)
    assert isinstance(part, Mark)
    place = frame.drawn(part.place)
    ball = api.add_icosphere(name, radius=0.012 * EXTENT, color=STATION, position=place)
    if part.text:
        api.add_label(f"{name}/name", part.text, position=(0.0, 0.0, 0.02 * EXTENT), anchor="bottom-center")
    return ball


def draw_scene(api: Any, scene: Scene, before: Mapping[str, Any]) -> dict[str, Any]:
    """Everything, in place of the nodes `before`; returns the nodes by name."""
    for node in before.values():
        node.remove()
    return {part.name: draw(api, scene.frame, part) for part in scene.parts}


def path_of(name: str) -> str:
    """Return the path of a node, its name without what separates nodes."""
    return "/" + name.replace("/", " ")


def _sheet(api: Any, frame: Frame, part: Sheet) -> Any:
    """A picture's columns run along x of its node, its rows along y."""
    wide, tall = np.linalg.norm(part.right), np.linalg.norm(part.down)
    x, y = part.right / wide, part.down / tall
    turn = Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)])).as_quat(scalar_first=True)
    middle = part.corner + (part.right + part.down) / 2
    return api.add_image(
        path_of(part.name), part.image, float(wide * frame.scale), float(tall * frame.scale),
        cast_shadow=False, receive_shadow=False, wxyz=turn, position=frame.drawn(middle),
    )  # fmt: skip


def floor(api: Any, scene: Scene) -> float:
    """Draw a grid beneath the scene; returns the side of its cells [m]."""
    frame = scene.frame
    wide = EXTENT / frame.scale
    side = 10.0 ** np.floor(np.log10(wide / 5))
    side *= next(n for n in (5, 2, 1) if n * side <= wide / 5)
    middle = np.array([*frame.middle[:2], scene.ground])
    api.add_grid(
        "/grid", 1.4 * EXTENT, 1.4 * EXTENT, cell_size=side * frame.scale,
        section_size=5 * side * frame.scale, position=frame.drawn(middle), shadow_opacity=0.0,
    )  # fmt: skip
    return float(side)


def first_view(camera: Any, aside: float = ASIDE, up: float = 0.0) -> None:
    """Look at the site from the south and above, `aside` widths past its middle and `up` above it."""
    past = np.array([aside, 0.0, up])
    camera.position = tuple(EXTENT * (np.array(ABOVE) + past))
    camera.look_at = tuple(EXTENT * past)
    camera.up = (0.0, 0.0, 1.0)
