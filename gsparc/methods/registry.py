"""Methods by name, imported when asked for, and methods built from `conf/model/*.yaml`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hydra.utils import get_class, get_method, instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.data.instantiate import refuse_foreign, suggest, targets
from gsparc.data.plugins import plugins
from gsparc.methods.method import Method

METHODS = {
    "zero": "gsparc.methods.zero.Zero",
    "mean": "gsparc.methods.mean.Mean",
    "nearest": "gsparc.methods.nearest.Nearest",
    "idw": "gsparc.methods.idw.InverseDistance",
    "distance_law": "gsparc.methods.distance_law.DistanceLaw",
    "gp": "gsparc.methods.gp.GaussianProcess",
    "kriging": "gsparc.methods.kriging.Kriging",
    "gsrf": "gsparc.peers.gsrf.GSRF",
    "wrfgs": "gsparc.peers.wrfgs.WRFGSPlus",
    "swiftwrf": "gsparc.peers.swiftwrf.SwiftWRF",
    "nerf2": "gsparc.peers.nerf2.NeRF2",
    "ngrf": "gsparc.peers.ngrf.NGRF",
    "newrf": "gsparc.peers.newrf.NeWRF",
    "calibrated_raytracer": "gsparc.peers.calibrated_raytracer.CalibratedRayTracer",
    "ridge": "gsparc.methods.ridge.Ridge",
    "fire": "gsparc.peers.fire.Fire",
    "uplink": "gsparc.multipath.uplink.method.UplinkField",
    "complex_gp": "gsparc.multipath.complex_gp.ComplexGP",
    "image_source_gp": "gsparc.multipath.image_source_gp.ImageSourceGP",
    "directional_gp": "gsparc.multipath.directional_gp.DirectionalGP",
    "array": "gsparc.array.method.ArrayField",
    "moving_array": "gsparc.array.moving.method.MovingArrayField",
    "gsparc": "gsparc.training.gsparc.Gsparc",
}

INITIALISERS = {  # of a splatted field, by the coherent term they are for
    "array": "gsparc.array.splat_init.ThroughArray",
}


def initialiser(name: str) -> Any:
    """The initialiser (`gsparc.field.initial.Initialiser`) called `name`."""
    return get_class(INITIALISERS[name])()


FIELDS = {  # fields whose weights are in closed form: what makes them of measurements, and of a state
    "sources": ("gsparc.multipath.initialise.sources", "gsparc.multipath.source_field.restored_sources"),
    "scene": ("gsparc.multipath.initialise.scene", "gsparc.multipath.source_field.restored_sources"),
    "rays": ("gsparc.multipath.initialise.rays", "gsparc.multipath.source_field.restored_rays"),
    "diffuse": ("gsparc.multipath.initialise.diffuse", "gsparc.multipath.waves.field.restored"),
    "powers": ("gsparc.multipath.initialise.powers", "gsparc.multipath.powers.field.restored"),
    "joint_powers": (
        "gsparc.multipath.initialise.joint_powers",
        "gsparc.multipath.powers.together.field.restored",
    ),
    "bearings": ("gsparc.array.moving.initialise.bearings", "gsparc.array.moving.bearing_field.restored"),
    "process": ("gsparc.training.process_field.initialise", "gsparc.training.process_field.restored"),
}


def field_initialiser(name: str) -> Any:
    """The initialiser `(data, rows, init, clutter, context) -> (field, report)` called `name`."""
    return get_method(FIELDS[name][0])


def field_restored(name: str) -> Any:
    """The function `(site, state) -> field` that reads back what the initialiser `name` made."""
    return get_method(FIELDS[name][1])


def known() -> dict[str, str]:
    """Import paths of all methods by name: `METHODS` and what plugins bring."""
    return plugins("model") | METHODS


def method_class(name: str) -> type[Method]:
    """The class called `name`; `ValueError` with the nearest right name when there is none."""
    if name in METHODS:  # before plugins, whose entry points take milliseconds to read
        return get_class(METHODS[name])
    there = known()
    if name not in there:
        raise ValueError(f"no method is called {name!r}{suggest(name, there)}")
    return get_class(there[name])


def build(config: Mapping[str, Any], *, trusted: bool = True) -> Method:
    """The method that a config of the group `model` describes (unfitted).

    Args:
        config: `_target_` and its arguments.
        trusted: False for text out of a file: then every `_target_` must be a class of gsparc.

    Raises:
        ValueError: no or wrong `_target_`, or arguments it does not take.
    """
    node = config if isinstance(config, DictConfig) else OmegaConf.create(dict(config))
    target = node.get("_target_")
    if target is None:
        raise ValueError("model: the config names no _target_ (choose one with model=NAME)")
    if not trusted:
        for path in targets(OmegaConf.to_container(node, resolve=False)):
            refuse_foreign(path)
    method = instantiate(node)
    if not isinstance(method, Method):
        raise ValueError(f"model: {target} is not a gsparc.methods.method.Method")
    return method
