"""Methods by name: `conf/model` says which class each is;
types and defaults of settings are the class's.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any

import yaml
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf, open_dict

from gsparc.base.instantiate import (
    accepted_arguments,
    config_node,
    import_target,
    iterate_targets,
    plugins,
    refuse_foreign,
    suggest_or_list,
)
from gsparc.base.limits import SettingError

if TYPE_CHECKING:  # brings torch, which a list of choices does not need
    from gsparc.models.method import MethodFactory


@cache
def built_in_methods() -> dict[str, str]:
    """Return import paths of the methods of `conf/model`, by name."""
    files = (
        file
        for file in resources.files("gsparc.conf").joinpath("model").iterdir()
        if file.is_file()
    )
    nodes = {file.name: yaml.safe_load(file.read_text(encoding="utf-8")) for file in files}
    return {name.removesuffix(".yaml"): nodes[name]["_target_"] for name in sorted(nodes)}


def all_methods() -> dict[str, str]:
    """Return import paths of all methods by name: `built_in_methods()` and what plugins bring."""
    return plugins("model") | built_in_methods()


def method_class(name: str) -> type[MethodFactory]:
    """Return what makes the method `name`; `ValueError` with the nearest right name
    if there is none.
    """
    if name in built_in_methods():  # before plugins, whose entry points take milliseconds to read
        return get_class(built_in_methods()[name])
    there = all_methods()
    if name not in there:
        raise ValueError(f"no method is called {name!r}{suggest_or_list(name, there)}")
    return get_class(there[name])


@cache
def plain_methods() -> tuple[str, ...]:
    """Return names of plain methods, which others are shown beside, in the order of tables."""
    classes = ((name, import_target(path)) for name, path in all_methods().items())
    # A class of its own: what derives from a plain method is none.
    orders = {
        name: vars(method).get("baseline_order") for name, method in classes if method is not None
    }
    places = {name: place for name, place in orders.items() if place is not None}
    return tuple(sorted(places, key=places.__getitem__))


def build(config: Mapping[str, Any], *, trusted: bool = True) -> MethodFactory:
    """Return the method that a config of the group `model` describes (unfitted),
    or what chooses it.

    Args:
        config: `_target_` and its arguments.
        trusted: False for text out of a file: then every `_target_` must be a class of gsparc or of
            an installed plugin, or a term that was imported.

    Raises:
        ValueError: no or wrong `_target_`, or settings it does not take.
    """
    node = config if isinstance(config, DictConfig) else OmegaConf.create(dict(config))
    target = node.get("_target_")
    if target is None:
        raise ValueError("model: the config names no _target_ (choose one with model=NAME)")
    from gsparc.models.method import MethodFactory
    from gsparc.processes.stored import find_kind

    terms = set(iterate_targets(OmegaConf.to_container(OmegaConf.create({"": node.get("terms")}))))
    for path in terms:
        if trusted:
            _import_term(path)
        else:
            find_kind(str(path))
    if not trusted:
        for path in set(iterate_targets(OmegaConf.to_container(node, resolve=False))) - terms:
            refuse_foreign(path)
    method = instantiate(fill_defaults(deepcopy(node)), _convert_="all")
    if not isinstance(method, MethodFactory):
        raise ValueError(f"model: {target} is not a gsparc.models.method.Method")
    return method


def _import_term(path: str) -> None:
    """Raise a `ValueError` that says what to do where a term's class cannot be imported."""
    module, _, name = path.rpartition(".")
    try:
        getattr(import_module(module), name)
    except Exception as error:  # whatever the file of a user does when it is imported
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        say = "say PYTHONPATH=FOLDER of its file before the command"
        raise ValueError(f"model.terms: {path} cannot be imported ({why}); {say}") from None


def fill_defaults(
    node: DictConfig, own: Mapping[str, Any] | None = None, group: str = "model"
) -> DictConfig:
    """Return a node, completed in place at any depth by what its class takes with defaults.

    Args:
        node: `_target_` and some of its arguments.
        own: all of them with defaults; None: those of `_target_`.
        group: name of the node, for errors.

    Raises:
        SettingError: a setting that the class does not have, or a group of settings given as one
            value.
    """
    kind = import_target(str(node.get("_target_", (own or {}).get("_target_"))))
    if not isinstance(kind, type):  # refused where it is built
        return node
    own = config_node(kind) if own is None else own
    keys, names = set(node), {*own, *accepted_arguments(kind)} - {"_target_"}
    for name in (name for name in keys - names if not name.startswith("_")):
        hint = (
            suggest_or_list(name, names).replace("mean '", f"mean '{group}.")
            if names
            else ", which has none"
        )
        raise SettingError(f"{group}.{name}: no such setting of {kind.__name__}{hint}")
    with open_dict(node):
        node.update({name: default for name, default in own.items() if name not in keys})
    for name in keys & own.keys():
        if OmegaConf.is_interpolation(node, name):
            continue
        value, default = node.get(name), own[name]
        # A group of the run, which the method's follows
        if name == "init" and isinstance(value, str):
            raise SettingError(f"{group}.{name}={value}: say {name}={value}")
        if isinstance(default, Mapping) and not isinstance(value, DictConfig):
            # After `_target_`
            some = "=..., ".join(f"{group}.{name}.{key}" for key in list(default)[1:3])
            fault = f"{group}.{name}={value}: is a group of settings"
            raise SettingError(f"{fault}, given one by one: {some}=...")
        if isinstance(default, Mapping):
            fill_defaults(value, default, f"{group}.{name}")
    return node
