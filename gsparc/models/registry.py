"""Methods by name: choices of `model=` with the settings of their classes, which are imported when chosen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.data import heeded
from gsparc.data.instantiate import find, node_of, plugins, refuse_foreign, suggest, targets
from gsparc.data.limits import SettingError

if TYPE_CHECKING:  # brings torch, which a list of choices does not need
    from gsparc.models.method import Method

METHODS = {
    "zero": "gsparc.models.baselines.zero.Zero",
    "mean": "gsparc.models.baselines.mean.Mean",
    "nearest": "gsparc.models.baselines.nearest.Nearest",
    "idw": "gsparc.models.baselines.idw.InverseDistance",
    "distance_law": "gsparc.models.baselines.distance_law.DistanceLaw",
    "gp": "gsparc.models.baselines.gp.GaussianProcess",
    "kriging": "gsparc.models.baselines.kriging.Kriging",
    "gsrf": "gsparc.models.peers.gsrf.GSRF",
    "wrfgs": "gsparc.models.peers.wrfgs.WRFGSPlus",
    "swiftwrf": "gsparc.models.peers.swiftwrf.SwiftWRF",
    "nerf2": "gsparc.models.peers.nerf2.NeRF2",
    "ngrf": "gsparc.models.peers.ngrf.NGRF",
    "newrf": "gsparc.models.peers.newrf.NeWRF",
    "calibrated_raytracer": "gsparc.models.peers.calibrated_raytracer.CalibratedRayTracer",
    "ridge": "gsparc.models.baselines.ridge.Ridge",
    "fire": "gsparc.models.peers.fire.Fire",
    "uplink": "gsparc.models.uplink.method.UplinkField",
    "complex_gp": "gsparc.models.channels.complex_gp.ComplexGP",
    "image_source_gp": "gsparc.models.image_sources.method.ImageSourceGP",
    "directional_gp": "gsparc.models.directional.method.DirectionalGP",
    "splat": "gsparc.models.splat.alone.Splat",
    "array": "gsparc.models.splat.array.ArrayField",
    "moving_array": "gsparc.models.moving_array.method.MovingArrayField",
    "gsparc": "gsparc.models.gsparc.Gsparc",
}


class _Chosen(ConfigNode):
    """A choice of `model=` that reads its class when it is chosen: to import all of them takes a second."""

    def __init__(self, name: str, path: str) -> None:
        self.name, self.path = f"{name}.yaml", path
        self.group, self.package, self.provider = "model", None, "gsparc"

    def __getattr__(self, attribute: str) -> DictConfig:
        if attribute != "node":
            raise AttributeError(attribute)
        return OmegaConf.create(method_node(self.path))


def method_node(path: str) -> dict[str, Any]:
    """What `model=` holds of the class that an import path names; some of it follows the run's settings."""
    kind: type[Method] = get_class(path)
    return node_of(kind, kind.linked)


def offer() -> None:
    """Make every method a choice of Hydra's group `model`."""
    models = ConfigStore.instance().repo.setdefault("model", {})
    models |= {f"{name}.yaml": _Chosen(name, path) for name, path in METHODS.items()}


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
    from gsparc.models.method import Method

    kind = find(str(target))
    if isinstance(kind, type):
        _refuse_words("model", node, node_of(kind))
    with heeded.apart():  # what is handed on is not used yet
        method = instantiate(node)
    if not isinstance(method, Method):
        raise ValueError(f"model: {target} is not a gsparc.models.method.Method")
    return method


def _refuse_words(group: str, node: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """`SettingError` where a group of settings, at any depth, is given as one value."""
    for name, own in defaults.items():
        value = node.get(name, own)
        if name == "init" and isinstance(value, str):  # a group of the run, which the method's follows
            raise SettingError(f"{group}.{name}={value}: say {name}={value}")
        if not isinstance(own, Mapping):
            continue
        if not isinstance(value, Mapping):
            some = "=..., ".join(f"{group}.{name}.{key}" for key in list(own)[1:3])  # after `_target_`
            raise SettingError(
                f"{group}.{name}={value}: is a group of settings, given one by one: {some}=..."
            )
        _refuse_words(f"{group}.{name}", value, own)
