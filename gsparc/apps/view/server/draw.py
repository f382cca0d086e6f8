"""A scene as nodes of `viser`, its floor and where it is looked at from, in drawn units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gsparc.apps.view.scene import EXTENT, DrawnScene

ABOVE = (0.15, -0.95, 0.8)  # where a camera first stands, in widths of the site
ASIDE = 0.15  # how far east of the site it looks, where a panel covers what lies there


def draw_scene(api: Any, scene: DrawnScene, before: Mapping[str, Any]) -> dict[str, Any]:
    """Draw everything, in place of the nodes `before`; returns the nodes by name."""
    for node in before.values():
        node.remove()
    return {part.name: part.draw(api, scene.frame) for part in scene.parts}


def draw_ground_grid(api: Any, scene: DrawnScene) -> float:
    """Draw a grid beneath the scene; returns the side of its cells [m]."""
    frame = scene.frame
    wide = EXTENT / frame.scale
    side = 10.0 ** np.floor(np.log10(wide / 5))
    side *= next(n for n in (5, 2, 1) if n * side <= wide / 5)
    middle = np.array([*frame.middle[:2], scene.ground])
    api.add_grid(
        "/grid",
        1.4 * EXTENT,
        1.4 * EXTENT,
        cell_size=side * frame.scale,
        section_size=5 * side * frame.scale,
        position=frame.to_drawn(middle),
        shadow_opacity=0.0,
    )
    return float(side)


def set_first_view(camera: Any, aside: float = ASIDE, up: float = 0.0) -> None:
    """Look at the site from the south and above,
    `aside` widths past its middle and `up` above it.
    """
    past = np.array([aside, 0.0, up])
    camera.position = tuple(EXTENT * (np.array(ABOVE) + past))
    camera.look_at = tuple(EXTENT * past)
    camera.up = (0.0, 0.0, 1.0)
