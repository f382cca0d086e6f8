"""Options of the command line that a fitted method does not follow, named in one warning."""

from __future__ import annotations

import logging
from collections import defaultdict

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from gsparc.data.schema import Measurements
from gsparc.models.fitting import dotted_settings
from gsparc.models.method import Method

log = logging.getLogger(__name__)

# Groups that methods name in `settings_read`; all others concern the run, and are always followed.
JUDGED = (
    "model",
    "init",
    "trainer",
    "callbacks",
    "dataset.batch_size",
    "effort",
    "stations",
    "split",
)
# Say nothing of what is done
NAMES = ("model._target_", "model.name", "model.guesses", "split.name")
ALONE = (
    "a plain process has all the weight, Gaussians (%s) none: model=splat is the field alone, and "
)
ALONE += "model.effects.residual=false leaves the process out"
REDRAW = "the dataset names its test rows: say split.redraw=true"


def command_line_options() -> dict[str, str]:
    """Return what the command line says: words by dotted names of settings."""
    if not HydraConfig.initialized():
        return {}
    hydra = HydraConfig.get()
    words: dict[str, str] = {}
    # Hydra's own grammar: quotes, lists and + or ~ at the head are not to be split by hand.
    for parse_override in OverridesParser.create().parse_overrides(list(hydra.overrides.task)):
        path, value = parse_override.key_or_group, parse_override.value()
        inner = dotted_settings(value, f"{path}.") if isinstance(value, dict) else [(path, value)]
        words |= {name: parse_override.input_line or name for name, _ in inner}
    return {path: text.lstrip("+") for path, text in words.items()}


def warn_of_unheeded(config: DictConfig, method: Method, data: Measurements) -> str | None:
    """Name the options without effect, in one warning too; None where there are none.

    Args:
        config: as composed from conf/train.yaml.
        method: fitted.
        data: that it learned from.
    """
    followed = {f"model.{name}" for name in method.settings_read()} | method.settings_read()
    followed |= {"effort"} if method.takes_effort else set()
    followed |= {"stations"} if data.site.several else set()
    # `random` alone takes the rows that a release names, and then no other setting of it.
    released = (
        data.release_split is not None and config.split.name == "random" and not config.split.redraw
    )
    followed |= set() if released else {"split"}
    why: dict[str, list[str]] = defaultdict(list)
    for path, text in command_line_options().items():
        if (
            path != "model"
            and path not in NAMES
            and _lies_in(path, JUDGED)
            and not _lies_in(path, followed)
        ):
            why[_instead(path, method)].append(text)
    words = "; ".join(f"{', '.join(options)} ({text})" for text, options in why.items())
    if why:
        log.warning("%s", f"options without effect here: {words}")
    if method.without_process() is not None and not method.count_components():
        log.warning(ALONE, method.facts()["model/choices"])
    return ", ".join(text for options in why.values() for text in options) or None


def _lies_in(path: str, groups: set[str] | tuple[str, ...]) -> bool:
    """Whether a setting is one of these or lies in one: prefixes end at a dot."""
    return any(f"{path}.".startswith(f"{group}.") for group in groups)


def _instead(path: str, method: Method) -> str:
    """Why an option has no effect, and what to set instead where that is known."""
    group = path.partition(".")[0]
    reasons = {
        "effort": f"{method.name} counts nothing",
        "stations": "there is one station",
        "split": REDRAW,
        "trainer": f"{method.name} takes no gradient steps here: model=splat does",
    }
    reasons |= dict.fromkeys(("callbacks", "dataset"), reasons["trainer"])
    return reasons.get(group, f"{method.name} does not use it here")
