"""Maps of a trained model with calibrated intervals, where to measure next, where to put a station."""

from importlib import import_module
from typing import Any

_PUBLIC = {
    "FieldMap": "gsparc.maps.field_map",
    "plan_next": "gsparc.maps.planning",
    "place_next": "gsparc.maps.placing",
    "map_of": "gsparc.maps.making",
}
__all__ = ["FieldMap", "map_of", "place_next", "plan_next"]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsparc.maps' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)
