"""How often maps keep their promise on measured sets, and what planned measurements save.

python bench/maps.py promise plane FILE gsparc 0 1 2 >> promise.csv    # draws 0, 1 and 2
python bench/maps.py campaign plane FILE 0 1 2 >> campaign.csv
"""

from __future__ import annotations

import sys
import time

import numpy as np

from gsparc.data.load import datamodule, split_for
from gsparc.data.schema import Measurements
from gsparc.data.splits import SplitSettings
from gsparc.maps.intervals import held, of_held
from gsparc.maps.promise import PromiseSettings, answerable, evidence_of, gather
from gsparc.methods.method import FitContext, Method
from gsparc.methods.per_station import for_links
from gsparc.methods.registry import method_class

SETS = {  # settings of the dataset, side of held-out blocks [m]
    "plane": ({"name": "own", "min_rssi_db": -75, "max_rows": 3000}, 0.3),
    "city": ({"name": "powder", "max_rows": 800}, 300.0),
    "hall": ({"name": "ble"}, 4.0),
}


def load(name: str, file: str) -> Measurements:
    """The set called so."""
    return datamodule({**SETS[name][0], "file": file}).measurements


def make(name: str) -> Method:
    """An unfitted method; the field with what `conf/model/gsparc.yaml` sets."""
    if name != "gsparc":
        return method_class(name)()
    from hydra import compose, initialize_config_module

    from gsparc.methods.registry import build

    with initialize_config_module("gsparc.conf", version_base="1.3"):
        config = compose("train", overrides=["model=gsparc", "model.steps=0"])
    return build(config.model)


def promise(name: str, file: str, method: str, draws: list[int], folds: int = 4) -> None:
    """A line of each draw: share of held-out blocks' rows inside, widths, and the model's own."""
    data, side = load(name, file), SETS[name][1]
    for draw in draws:
        began = time.perf_counter()
        split = {"name": "blocks", "side_m": side, "seed": draw, "share": 0.2}
        fold = split_for(split, data).folds[0]
        context = FitContext(budget_s=60.0, split=SplitSettings("blocks", side_m=side))
        fitted = for_links(lambda: make(method), data)
        fitted.fit(data, fold, context)
        fold = answerable(fitted, data, fold)
        trained = time.perf_counter() - began
        settings = PromiseSettings(folds=folds, seed=draw, block_m=side / 2)
        known = gather(fitted, lambda: make(method), data, fold, settings, context)
        found = evidence_of(fitted, data, fold, np.zeros(len(fold.test), np.int64))
        inside, width = held(known.calibration(), found)
        kept = of_held(found, inside, width, np.isfinite(width), 0, 0.9)
        rmse = np.sqrt(np.mean((found.level_db - found.mean_db) ** 2))
        values = (kept.share, kept.width_db, kept.reached, kept.own_share, kept.own_width_db, rmse)
        spent = f"{trained:.1f},{time.perf_counter() - began - trained:.1f}"
        said = ",".join(f"{value:.4f}" for value in values)
        sys.stdout.write(f"{name},{method},{draw},{kept.rows},{said},{spent}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    kind, which, where, *rest = sys.argv[1:]
    if kind == "promise":
        promise(which, where, rest[0], [int(one) for one in rest[1:]])
