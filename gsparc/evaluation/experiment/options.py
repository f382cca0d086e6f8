"""Options that a run was given and did not heed, named in one warning with what to set instead."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from gsparc.data.heeded import Option, Reads
from gsparc.data.instantiate import import_target
from gsparc.data.schema import Measurements
from gsparc.data.splits import FileSettings, Split, SplitSettings
from gsparc.evaluation.scores import rows_to_score
from gsparc.models.fitting import dotted_settings
from gsparc.models.method import Method, MethodFactory

log = logging.getLogger(__name__)

# Counted where they are heeded; of other settings only those are judged whose reads are noted.
COUNTED = ("trainer", "callbacks", "dataset.batch_size", "effort", "stations")
RENDERED = (  # settings of the model that only rasterized Gaussians have
    "field", "emission", "attenuation", "raster", "response", "confidence", "loss", "optimizer", "refit",
    "keep_best", "steps",
)  # fmt: skip
ALONE = "a plain process has all the weight, Gaussians (%s) none: model=splat is the field alone, and "
ALONE += "model.effects.residual=false leaves the process out"
REDRAW = "the dataset names its test rows: say split.redraw=true"
STEPS = "no gradient steps are asked for: say model.steps=auto"
NAMES = ("_target_", "name", "guesses")  # settings that say nothing of what is done


def command_line_options() -> dict[str, str]:
    """Return what the command line says: words by dotted names of settings."""
    if not HydraConfig.initialized():
        return {}
    hydra = HydraConfig.get()
    words: dict[str, str] = {}
    # Hydra's own grammar: quotes, lists and + or ~ at the head are not to be split by hand.
    for one in OverridesParser.create().parse_overrides(list(hydra.overrides.task)):
        path, value = one.key_or_group, one.value()
        inner = dotted_settings(value, f"{path}.") if isinstance(value, dict) else [(path, value)]
        words |= {name: one.input_line or name for name, _ in inner}
    # A file of the group `init` is as good as its name.
    return {"init.name" if path == "init" else path: text.lstrip("+") for path, text in words.items()}


def options_to_note(config: DictConfig, method: MethodFactory) -> Reads:
    """Return what is to be noted of the options of the command line, for what `config.model` describes."""
    options = []
    for path in command_line_options():
        group, _, name = path.rpartition(".")
        node = OmegaConf.select(config, group) if group else None
        if isinstance(node, DictConfig) and name in node and (name not in NAMES or path == "init.name"):
            value = OmegaConf.select(config, path)
            options += [Option(path, value, *holder) for holder in _holders(path, node, method)]
    return Reads(options)


def _holders(path: str, node: DictConfig, method: MethodFactory) -> Iterator[tuple[type, str]]:
    """Classes and attributes that hold a setting, none where this is not known."""
    group, _, name = path.rpartition(".")
    stored = method.stored_names.get(path.removeprefix("model."))
    kind: Any = import_target(str(node.get("_target_")))
    if group == "split":
        kind = FileSettings if node.name == "file" else SplitSettings
    as_named = group == "model" and stored is None and vars(method).get(name, ...) == node[name]
    if as_named or name in getattr(kind, "__dataclass_fields__", ()):
        yield kind, name
    if stored is not None:  # "" is the name of nothing that is read
        owner, _, attribute = stored.rpartition(".")
        yield type(getattr(method, owner) if owner else method), attribute


def ask_one_query(method: Method, data: Measurements, split: Split, eval_on: str) -> None:
    """Ask a fitted method once: some options are read by answers alone."""
    rows = rows_to_score(split.folds[0], "train" if split.name == "none" else eval_on)
    method.predict(data.batch(rows[:1]))


def warn_of_unheeded(reads: Reads, method: Method, data: Measurements) -> str | None:
    """Name the options without effect, in one warning too; None where there are none.

    Args:
        reads: of a fit and a prediction.
        method: fitted.
        data: that it learned from.
    """
    counted = {"effort": method.takes_effort, "stations": data.site.several}
    reads.noted |= {name for name, heeded in counted.items() if heeded}
    paths = {option.path for option in reads.options}
    why: dict[str, list[str]] = defaultdict(list)
    for path, text in command_line_options().items():
        # Prefixes end at a dot, else `trainer` would count `trainer_x`.
        judged = path in paths or any(f"{path}.".startswith(f"{name}.") for name in COUNTED)
        if judged and not reads.heeds(path):
            why[_instead(path, method, reads, data)].append(text)
    words = "; ".join(f"{', '.join(one)} ({text})" for text, one in why.items())
    if why:
        log.warning("%s", f"options without effect here: {words}")
    if method.without_process() is not None and not method.count_components():
        log.warning(ALONE, method.facts()["model/choices"])
    return ", ".join(text for one in why.values() for text in one) or None


def _instead(path: str, method: Method, reads: Reads, data: Measurements) -> str:
    """Why an option has no effect, and what to set instead where that is known."""
    (group, _, name), noted = path.partition("."), reads.noted
    training = group in ("trainer", "callbacks", "dataset") or path == "model.steps"
    rendered = group == "model" and name.partition(".")[0] in RENDERED and not method.takes_weights
    started = method.facts()["model/init"] if group == "init" else None
    # The first that holds is told: from what decides all options to what concerns one.
    reasons = (
        (path == "effort", f"{method.name} counts nothing"),
        (path == "stations", "there is one station"),
        (group == "split" and data.release_split is not None, REDRAW),
        (group == "split", "this split does not use it"),
        (path == "model.steps" and "trainer.max_steps" in noted, "steps of the Trainer win"),
        (training and "trainer" in noted, "this training does not call for it"),
        (training and {"model.steps", "trainer.max_steps"} & noted, STEPS),
        (training, f"{method.name} takes no gradient steps here: model=splat does"),
        (rendered, "of rendered Gaussians alone: say model=splat"),
        (started is not None, f"here it is init={started}"),
    )
    return next((text for holds, text in reasons if holds), f"{method.name} does not use it here")
