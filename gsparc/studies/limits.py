"""What each setting may be, checked before anything is computed; an error names it as it was said."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from gsparc.data.instantiate import suggest
from gsparc.methods.registry import METHODS


@dataclass(frozen=True)
class Limit:
    """What a setting may be.

    Attributes:
        words: the same for people.
        holds: whether a value is one.
        known: choices, for suggesting the nearest.
    """

    words: str
    holds: Callable[[Any], bool]
    known: tuple[str, ...] = ()


def whole(least: int, most: int | None = None) -> Limit:
    """A whole number from `least`."""
    words = f"a whole number of at least {least}" + ("" if most is None else f" and at most {most}")
    return Limit(words, lambda v: type(v) is int and v >= least and (most is None or v <= most))


def number(low: float, high: float = math.inf, *, open_low: bool = False, open_high: bool = False) -> Limit:
    """A finite number between `low` and `high`."""
    words = f"a number {'above' if open_low else 'of at least'} {low:g}"
    words += "" if high == math.inf else f" and {'below' if open_high else 'at most'} {high:g}"
    return Limit(
        words,
        lambda v: _real(v) and (v > low if open_low else v >= low) and (v < high if open_high else v <= high),
    )


def choice(*values: str) -> Limit:
    """One of a few words."""
    return Limit(f"one of {', '.join(values)}", lambda v: v in values, values)


def switch(*more: str) -> Limit:
    """True, false, or one of a few words."""
    words = ("true", "false", *more)
    return Limit(f"one of {', '.join(words)}", lambda v: isinstance(v, bool) or v in more, words)


def or_null(limit: Limit) -> Limit:
    """The same, or nothing."""
    return Limit(f"{limit.words}, or null", lambda v: v is None or limit.holds(v), limit.known)


def _real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _methods(value: Any) -> bool:
    return isinstance(value, list) and all(name in METHODS for name in value)


LIMITS: dict[str, Limit] = {
    "seed": whole(0, 2**32 - 1),
    "threads": or_null(whole(1)),
    "eval_on": choice("train", "val", "test"),
    "trainer.gradient_clip_val": or_null(number(0, open_low=True)),
    "model.warm_start": switch("auto"),
    "model.refit": switch(),
    "model.field.count": whole(0),
    "model.field.margin": number(0),
    "model.field.near": number(0),
    "model.field.far": number(0, open_low=True),
    "model.field.opacity": number(0, 1, open_low=True, open_high=True),
    "model.field.scale": or_null(number(0, open_low=True)),
    "model.emission.hidden": whole(0),
    "model.emission.activation": choice("auto", "sigmoid", "softplus", "linear"),
    "model.emission.init_scale": number(0),
    "model.emission.encoding.octaves": whole(0, 30),
    "model.emission.encoding.anchors": whole(1),
    "model.attenuation.d_min": number(0, open_low=True),
    "model.attenuation.d_ref": or_null(number(0, open_low=True)),
    "model.attenuation.gain": number(0, open_low=True),
    "model.confidence.hidden": whole(1),
    "model.confidence.alpha": number(0),
    "model.confidence.clamp": number(0, 80, open_low=True),
    "model.loss.ssim_weight": number(0, 1),
    "model.loss.snapshot": choice("none", "phase", "phase_timing"),
    "model.response.pattern": number(0),
    "callbacks.pictures.every": whole(1),
    "callbacks.pictures.count": whole(1),
    "callbacks.densify.start": whole(0),
    "callbacks.densify.stop": whole(0),
    "callbacks.densify.interval": whole(1),
    "callbacks.densify.grad_threshold": number(0),
    "callbacks.densify.size_share": number(0),
    "callbacks.densify.children": whole(2),
    "callbacks.densify.max_radius": or_null(number(0, open_low=True)),
    "callbacks.densify.max_gaussians": whole(1),
    "callbacks.densify.min_gaussians": whole(0),
    "callbacks.reset.interval": whole(1),
    "callbacks.reset.stop": whole(0),
    "callbacks.reset.ceiling": number(0, 1, open_low=True, open_high=True),
}
RATE = number(0)


def check(config: Mapping[str, Any]) -> None:
    """Refuse a configuration (plain containers) whose settings cannot be; what it does not hold is not asked.

    Raises:
        ValueError: the first setting that is out of its limits, with what was expected.
    """
    for key, value in _leaves(config):
        limit = RATE if key.startswith("model.optimizer.") else LIMITS.get(key)
        if limit is None and isinstance(value, float) and not math.isfinite(value):
            limit = Limit("a finite number", lambda v: False)
        if limit is None or key.endswith("._target_") or limit.holds(value):
            continue
        near = suggest(value, list(limit.known)) if limit.known and isinstance(value, str) else ""
        near = near if "did you mean" in near else ""
        raise ValueError(f"{key}={value!r}: {limit.words} is needed{near}")
    if "baselines" in config and not _methods(config["baselines"]):
        given = config["baselines"]
        wrong = next((b for b in given if b not in METHODS), given) if isinstance(given, list) else given
        hint = suggest(str(wrong), METHODS)
        raise ValueError(f"baselines={given}: a list of methods is needed, {wrong!r} is none{hint}")


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in node.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
