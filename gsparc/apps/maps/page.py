"""One offline HTML page of a map: layers to switch, and the value under the pointer."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment
from PIL import Image

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.floor_plan import FloorPlan
from gsparc.apps.maps.pictures import Layer
from gsparc.data.blocks import evenly
from gsparc.data.files import whole_file
from gsparc.evaluation.from_above import MOST_POINTS

MOST_CELLS = 600  # along a side: the page shows every n-th cell of larger maps
LEVELS = 65_534  # of a value; 65535 is no value
NOTHING = 65_535
PLAN_PIXELS = 1600  # of a plan's longer side


def write_page(
    path: Path,
    field: FieldMap,
    layers: Sequence[Layer],
    title: str,
    lines: Sequence[str],
    plan: FloorPlan | None,
) -> None:
    """Write an HTML page of layers that needs nothing but itself; `lines` are what a reader must know."""
    every = max(1, -(-max(field.grid.shape) // MOST_CELLS))
    text = files("gsparc.apps.maps").joinpath("page.html.j2").read_text(encoding="utf-8")
    left, right, low, high = field.grid.extent
    few = field.places[evenly(len(field.places), MOST_POINTS)]
    stations = [
        {"name": name, "x": float(x), "y": float(y)}
        for name, (x, y) in zip(field.stations, field.station_place, strict=True)
        if np.isfinite([x, y]).all()
    ]
    content = {
        "extent": [left, right, low, high], "step": field.grid.step * every,
        "layers": [_encoded(layer, every) for layer in layers],
        "places": np.round(few, 3).tolist(), "stations": stations,
        "plan": None if plan is None else _plan(plan), "every": every,
        "refused": _bits(field.refused[::every, ::every]),
    }  # fmt: skip
    page = Environment(autoescape=True).from_string(text)
    html = page.render(title=title, lines=lines, content=content)
    with whole_file(path) as partial:
        partial.write_text(html, encoding="utf-8")


def _encoded(layer: Layer, every: int) -> dict[str, Any]:
    values = layer.values[::every, ::every].astype(np.float64)
    known = np.isfinite(values)
    least, most = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 1.0)
    scale = (most - least) / LEVELS or 1.0
    code = np.full(values.shape, NOTHING, np.uint16)
    code[known] = np.round((values[known] - least) / scale).astype(np.uint16)
    return {
        "name": layer.name, "label": layer.legend.label, "words": list(layer.words), "ny": values.shape[0],
        "nx": values.shape[1], "least": least, "scale": scale,
        "low": layer.legend.low, "high": layer.legend.high,
        "data": base64.b64encode(code.astype("<u2").tobytes()).decode(),
        "unsure": None if layer.unsure is None else _bits(layer.unsure[0][::every, ::every]),
        "colours": (layer.table()[:, :3] * 255).round().astype(int).tolist(),
    }  # fmt: skip


def _bits(values: np.ndarray) -> str:
    return base64.b64encode(np.packbits(values.reshape(-1)).tobytes()).decode()


def _plan(plan: FloorPlan) -> dict[str, Any]:
    picture = Image.fromarray(plan.image)
    shrink = max(1.0, max(picture.size) / PLAN_PIXELS)
    small = picture.resize((max(1, round(picture.width / shrink)), max(1, round(picture.height / shrink))))
    buffer = io.BytesIO()
    small.save(buffer, "PNG")
    a, b, c, d, e, f = plan.matrix()
    across, down = picture.width / small.width, picture.height / small.height
    return {
        "image": base64.b64encode(buffer.getvalue()).decode(),
        "matrix": [a * across, b * across, c * down, d * down, e, f],
    }
