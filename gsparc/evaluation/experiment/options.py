"""Options that a run was given and did not heed, named in one warning with what to set instead."""

from __future__ import annotations

import dataclasses
import logging
from collections import defaultdict
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from gsparc.data.heeded import Option, Reads
from gsparc.data.instantiate import find, node_of
from gsparc.data.schema import Measurements
from gsparc.data.splits import FileSettings, SplitSettings
from gsparc.evaluation.console import config_folder
from gsparc.models.method import Method, TrainsByGradient
from gsparc.models.parts import leaves
from gsparc.models.registry import build

log = logging.getLogger(__name__)

# Counted where they are heeded; of other settings only those are judged whose reads are noted.
COUNTED = ("trainer", "callbacks", "dataset.batch_size", "budget_s", "stations")
RENDERED = (  # settings of the model that only rasterized Gaussians have
    "field", "emission", "attenuation", "raster", "response", "confidence", "loss", "optimizer", "refit",
    "keep_best", "steps",
)  # fmt: skip
NAMES = ("_target_", "name", "guesses")  # settings that say nothing of what is done


def given() -> dict[str, str]:
    """What the command line and its experiment file say: words by dotted names of settings."""
    if not HydraConfig.initialized():
        return {}
    hydra = HydraConfig.get()
    experiment = _of_experiment(hydra.runtime, hydra.runtime.choices.get("experiment"))
    said = {path: f"{path}={value}" for path, value in experiment}
    for one in OverridesParser.create().parse_overrides(list(hydra.overrides.task)):
        path, value = one.key_or_group, one.value()
        inner = leaves(value, f"{path}.") if isinstance(value, dict) else [(path, value)]
        said |= {name: one.input_line or name for name, _ in inner}
    # A file of the group `init` is as good as its name.
    return {"init.name" if path == "init" else path: text.lstrip("+") for path, text in said.items()}


def _of_experiment(runtime: Any, choice: str | None) -> Iterator[tuple[str, Any]]:
    """What an experiment file says itself, after those of its folder that it builds on."""
    for source in runtime.config_sources if choice else ():
        folder = Path(source.path) if source.schema == "file" else config_folder()
        file = folder / "experiment" / f"{choice}.yaml"
        if file.exists():
            text = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
            for one in text.get("defaults", ()):
                if isinstance(one, str) and one != "_self_":
                    yield from _of_experiment(runtime, one)
            yield from leaves({key: value for key, value in text.items() if key not in ("defaults", "hydra")})
            return


def noting(config: DictConfig) -> Reads:
    """What is to be noted of the options that were `given`."""
    method, said = build(config.model), given()
    settings: Any = OmegaConf.to_container(config, resolve=True)
    options: dict[type, dict[str, list[Option]]] = defaultdict(lambda: defaultdict(list))
    for path in said:
        group, _, name = path.rpartition(".")
        node = OmegaConf.select(config, group) if group else None
        if not isinstance(node, DictConfig) or (name in NAMES and path != "init.name"):
            continue
        value = OmegaConf.select(config, path)
        for kind, attribute in _holders(path, node, method):
            options[kind][attribute].append(Option(path, value, node_of(kind).get(name)))

    def variant(path: str, value: Any) -> Method:
        model = node = deepcopy(settings["model"])
        *groups, name = path.removeprefix("model.").split(".")
        for one in groups:
            node = node[one]
        node[name] = value
        return build(model)

    return Reads(options, variant)


def _holders(path: str, node: DictConfig, method: Method) -> Iterator[tuple[type, str]]:
    """Classes and attributes that hold a setting, none where this is not known."""
    group, _, name = path.rpartition(".")
    within = path.removeprefix("model.")
    split = (FileSettings if node.get("name") == "file" else SplitSettings) if group == "split" else None
    kind: Any = split or find(str(node.get("_target_")))
    stored = method.stored_names.get(within, name) if group == "model" else name
    if dataclasses.is_dataclass(kind) and name in {f.name for f in dataclasses.fields(kind)}:
        yield kind, name
    elif group == "model" and name in method.stored_names and stored:
        yield kind, stored
    elif group == "model" and vars(method).get(name, ...) == node[name]:
        yield kind, name
    if group.startswith("model.") and (stored := method.stored_names.get(within, "")):
        *owners, attribute = stored.split(".")
        held: Any = method
        for owner in owners:
            held = getattr(held, owner)
        yield type(held), attribute


def unheeded(reads: Reads, method: Method, data: Measurements) -> str | None:
    """Name the options without effect, in one warning too; None where there are none.

    Args:
        reads: of a fit and a prediction.
        method: fitted.
        data: that it learned from.
    """
    stations = data.site.stations is not None and len(data.site.stations) > 1
    counted = {"budget_s": method.takes_budget, "stations": stations}
    reads.noted |= {name for name, heeded in counted.items() if heeded}
    known = {one.path for own in reads.options.values() for each in own.values() for one in each}
    known |= {f"model.{name}" for name, stored in method.stored_names.items() if not stored}
    why: dict[str, list[str]] = defaultdict(list)
    for path, text in given().items():
        judged = path in known or any(f"{path}.".startswith(f"{name}.") for name in COUNTED)
        if judged and not reads.heeds(path):
            why[_instead(path, method, reads, data)].append(text)
    if not why:
        return None
    words = "; ".join(f"{', '.join(one)} ({text})" for text, one in why.items())
    log.warning("options without effect here: %s", words)
    return ", ".join(text for one in why.values() for text in one)


def _instead(path: str, method: Method, reads: Reads, data: Measurements) -> str:
    """Why an option has no effect, and what to set instead where that is known."""
    group, _, name = path.partition(".")
    if path == "budget_s":
        return f"the seconds of {method.name} cannot be chosen"
    if path == "stations":
        return "there is one station"
    if group == "split":
        own = "the dataset names its test rows: say split.redraw=true"
        return own if data.release_split is not None else "this split does not use it"
    if method.field_alone() is not None and not method.size():
        own = "model=splat is the field alone, model.effects.residual=false leaves the process out"
        return f"a plain process has all the weight: {own}"
    if path == "model.steps" and "trainer.max_steps" in reads.noted:
        return "steps of the Trainer win"
    if group in ("trainer", "callbacks", "dataset") or path == "model.steps":
        if "trainer" in reads.noted:
            return "this training does not call for it"
        if {"model.steps", "trainer.max_steps"} & reads.noted:
            return "no gradient steps are asked for: say model.steps=auto"
        return f"{method.name} takes no gradient steps here: model=splat does"
    if isinstance(method, TrainsByGradient) and name.partition(".")[0] in RENDERED and group == "model":
        return "of rendered Gaussians alone: say model=splat"
    started = method.facts()["model/init"] if group == "init" else None
    return f"{method.name} does not use it here" if started is None else f"here it is init={started}"
