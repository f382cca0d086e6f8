"""Settings that every command has."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from threadpoolctl import threadpool_limits

from gsparc.base import executor
from gsparc.base.executor import Engine
from gsparc.base.instantiate import suggest_or_list
from gsparc.base.limits import (
    POSITIVE,
    Checked,
    Limit,
    SettingError,
    choice,
    or_null,
    setting,
    whole,
)
from gsparc.evaluation.console import to_dict as to_dict
from gsparc.models.registry import all_methods
from gsparc.training.effort import refuse_seconds


@dataclass(frozen=True)
class RunSettings(Checked):
    """Settings of a run as a whole; a command has those of them that its configuration names.

    Attributes:
        seed: of whatever is random.
        threads: CPU threads of torch; None takes what it finds. NumPy's factorisations use one.
        eval_on: rows that are scored.
        baselines: names of methods; None: all plain ones that serve the data.
        effort: that all counts of a fit are multiplied by.
        stations: `auto`, `each` or `together`.
        draws: trials of a promise.
    """

    seed: int = setting(0, whole(0, 2**32 - 1))
    threads: int | None = setting(None, or_null(whole(1)))
    eval_on: str = setting("test", choice("train", "val", "test"))
    baselines: tuple[str, ...] | None = ()
    effort: float = setting(1.0, POSITIVE)
    stations: str = setting("auto", choice("auto", "each", "together"))
    draws: int = setting(1, whole(1))

    @classmethod
    def from_config(cls, config: DictConfig) -> RunSettings:
        """Check what can be checked before anything is read, and set the number of threads.

        Raises:
            ValueError: a setting that cannot be, named as it is in the configuration.
        """
        values = OmegaConf.to_container(config, resolve=True)
        assert isinstance(values, dict)
        refuse_seconds(dict(_leaves(values)))
        arguments: dict[str, Any] = {
            f.name: values[f.name] for f in fields(cls) if f.name in values
        }
        if "model" not in values:  # names of stations to ask, not how they are learned
            arguments.pop("stations", None)
        settings = cls(**{**arguments, "baselines": _methods(arguments.get("baselines", []))})
        trainer = values.get("trainer") or {}
        clip = trainer.get("gradient_clip_val")
        or_null(POSITIVE).check("trainer.gradient_clip_val", clip)  # Lightning takes any number
        # Starts in closed form and refits learn from all rows
        if few := trainer.get("overfit_batches"):
            fault = (
                f"trainer.overfit_batches={few}: not supported; split.train_count=32 learns "
                "from few rows"
            )
            raise SettingError(f"{fault}, which eval_on=train then scores")
        accelerator = trainer.get("accelerator", "auto")
        kinds = ["auto", "gpu", *_accelerators()] if trainer else [accelerator]
        if accelerator not in kinds:  # Lightning says so, but not where a model takes no steps
            raise SettingError(f"trainer.accelerator={accelerator!r}: one of {', '.join(kinds)}")
        if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
            raise SettingError(
                f"trainer.accelerator={accelerator}: there is no GPU here; say trainer=cpu"
            )
        for name, node in (config.get("callbacks") or {}).items():
            if node is not None and not isinstance(node, Mapping):
                raise SettingError(
                    f"callbacks.{name}={node}: is a group of settings; null leaves it out"
                )
            instantiate(node)  # checks itself
        for key, value in _leaves(values):
            # YAML's .inf and .nan are floats, and no comparison with NaN refuses it.
            if isinstance(value, float):
                Limit("a finite number", math.isfinite).check(key, value)
        if settings.threads is not None:
            torch.set_num_threads(settings.threads)
        address = (values.get("ray") or {}).get("address")
        executor.use_engine(Engine(values.get("engine", "process"), values.get("workers"), address))
        # NumPy's: two threads beside other work took 10 to 400 times as long as one.
        threadpool_limits(1, "blas")
        return settings


def _accelerators() -> list[str]:
    # seconds; not every command trains
    from lightning.pytorch.accelerators import AcceleratorRegistry

    return sorted(AcceleratorRegistry.available_accelerators())


def _methods(names: Any) -> tuple[str, ...] | None:
    if names is None:
        return None
    methods = all_methods()
    if isinstance(names, list) and all(name in methods for name in names):
        return tuple(names)
    wrong = (
        next((b for b in names if b not in methods), names) if isinstance(names, list) else names
    )
    hint = suggest_or_list(str(wrong), methods)
    raise SettingError(f"baselines={names}: a list of methods is needed, {wrong!r} is none{hint}")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(node, Mapping):
        yield prefix, node
        return
    for key, value in node.items():
        yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))
