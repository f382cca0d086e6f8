"""Maps of a trained model with calibrated intervals, where to measure next, where to put a station."""

from importlib import import_module
from typing import Any

_PUBLIC = {
    "FieldMap": "gsparc.apps.maps.field_map",
    "plan_next": "gsparc.apps.maps.planning",
    "place_next": "gsparc.apps.maps.placing",
    "map_of": "gsparc.apps.maps.making",
}
__all__ = ["FieldMap", "map_of", "place_next", "plan_next"]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'gsparc.apps.maps' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)
