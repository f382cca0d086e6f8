"""The scenes that come with Sionna: their names and settings, without importing it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any


def list_shipped_scenes() -> list[str]:
    """Return names, sorted; none where Sionna is not installed."""
    spec = importlib.util.find_spec("sionna")
    folders = () if spec is None else tuple(spec.submodule_search_locations or ())
    files = (path for folder in folders for path in Path(folder).glob("rt/scenes/*/*.xml"))
    return sorted(path.stem for path in files if path.stem == path.parent.name)


def shipped_scene_settings(name: str) -> dict[str, Any]:
    """Return what `scene=NAME` means for a shipped scene that has no file in `conf/scene`."""
    return {
        "name": name,
        "builtin": name,
        "transmitter_m": None,
        "transmitters": None,
        "area_m": None,
        "height_m": [1.2, 1.8],
        "over": "ground",
        "receivers": None,
        "open_sky": None,
        "num_receivers": 1000,
        "test_share": 0.3,
        "carrier_hz": 3.5e9,
        "bandwidth_hz": 100.0e6,
        "subcarriers": 26,
        "scattering": None,
        "seed": 0,
    }
