"""`gsparc compare` on datasets that a script of this folder makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import pandas as pd

from gsparc.commands.compare import compare
from gsparc.evaluation.results import PROBLEM as PROBLEM
from gsparc.models.registry import plain_methods
from gsparc.runs.settings import RunSettings, to_dict


def compare_with_plain(
    folder: Path,
    datasets: Mapping[str, Any],
    splits: Mapping[str, Mapping[str, Any]],
    words: Sequence[str],
) -> pd.DataFrame:
    """Return `average_cells` of `model=gsparc` and every plain method, kept in `folder`.

    Args:
        datasets, splits: as in conf/compare.yaml.
        words: settings of conf/compare.yaml, `draws=4` of every split, which has one;
            without `=`: how names of the datasets that are wanted begin.
    """
    chosen = ["+draws=1", "latency=false", *(word for word in words if "=" in word)]
    with hydra.initialize_config_module("gsparc.conf", version_base="1.3"):
        config = hydra.compose("compare", overrides=chosen)
        RunSettings.from_config(config)
        settings = to_dict(config)
        methods, wanted = settings["methods"], {*plain_methods(), settings["ours"]}
        settings["methods"] = {name: methods[name] for name in methods if name in wanted}
        settings["splits"] = {n: {"draws": config.draws, **split} for n, split in splits.items()}
        settings |= {"datasets": datasets, "cells": str(folder / "cells")}
        settings["only"] = [f"{word}*" for word in words if "=" not in word] or settings["only"]
        return compare(settings, folder)
