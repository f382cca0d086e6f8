"""Scenes of Sionna from files, names and solids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.base.limits import choice
from gsparc.simulate.scenes.shipped import list_shipped_scenes
from gsparc.simulate.scenes.solid import LISTED_MATERIALS, Solid

# Thickness [m] and scattering coefficient, where a scene gives none.
MATERIALS = {
    row["material"]: (float(row["thickness_m"]), float(row["scattering"]))
    for row in LISTED_MATERIALS
}
OTHERS = (0.10, 0.20)


def load_scene(
    source: Sequence[Solid] | str | Path, carrier_hz: float, scattering: float | None
) -> Any:
    """Return a Sionna scene of solids, of a file, or of a name, at a carrier [Hz].

    Args:
        source: solids, the path of an XML file, or the name of a scene that Sionna ships.
        carrier_hz: of its materials.
        scattering: coefficient of all materials; None: of `MATERIALS`, where the scene has none.

    Raises:
        ValueError: no such file or scene, or one that Sionna cannot read.
    """
    import sionna.rt as rt

    def scatters(itu: str) -> float:
        return MATERIALS.get(itu, OTHERS)[1] if scattering is None else scattering

    if isinstance(source, (str, Path)):
        scene = _load_file(source)
        for material in scene.radio_materials.values():
            # Built-in scenes come with 0: diffuse reflection would silently contribute nothing.
            if float(material.scattering_coefficient[0]) == 0.0:
                material.scattering_coefficient = scatters(
                    getattr(material, "itu_type", None) or ""
                )
    else:
        scene = rt.load_scene()
        _add(scene, source, scatters)
    scene.frequency = float(carrier_hz)
    return scene


def _load_file(source: str | Path) -> Any:
    import sionna.rt as rt

    path = Path(source)
    if isinstance(source, Path) or path.suffix == ".xml":
        if not path.is_file():
            raise ValueError(f"scene.xml={source}: no such file")
        try:
            return rt.load_scene(str(path))
        except Exception as error:  # Mitsuba raises RuntimeError, Sionna several others
            first = next(
                (line for line in str(error).splitlines() if line.strip()), type(error).__name__
            )
            raise ValueError(
                f"scene.xml={source}: Sionna cannot read it ({first.strip()})"
            ) from error
    choice(*list_shipped_scenes()).check("scene.builtin", source)
    return rt.load_scene(getattr(rt.scene, str(source)))


def _add(scene: Any, solids: Sequence[Solid], scatters: Callable[[str], float]) -> None:
    import mitsuba as mi
    import sionna.rt as rt

    materials = {
        name: rt.ITURadioMaterial(
            f"itu-{name}",
            name,
            MATERIALS.get(name, OTHERS)[0],
            scattering_coefficient=scatters(name),
        )
        for name in sorted({solid.material for solid in solids})
    }
    objects = []
    for solid in solids:
        mesh = mi.Mesh(solid.name, vertex_count=len(solid.vertices), face_count=len(solid.faces))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ascontiguousarray(
            solid.vertices, dtype=np.float32
        ).ravel()
        parameters["faces"] = np.ascontiguousarray(solid.faces, dtype=np.uint32).ravel()
        parameters.update()
        material = materials[solid.material]
        objects.append(rt.SceneObject(mi_mesh=mesh, name=solid.name, radio_material=material))
    scene.add(objects)
