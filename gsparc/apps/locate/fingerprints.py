"""Fingerprints, levels of access points whose places nobody knows, placed by the nearest rows.

Areas are discs about the answers, as wide as errors of rows that were left out ask for (split conformal
prediction, J. Lei et al., J. Amer. Stat. Assoc. 113 (2018)).
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from gsparc.apps.locate.judging import Localisation, sample
from gsparc.apps.locate.locator import HELD_OUT
from gsparc.apps.locate.neighbours import located_by
from gsparc.apps.locate.snapshots import Snapshots
from gsparc.data.datasets.fingerprints import Fingerprints, parted, read_fingerprints
from gsparc.data.limits import POSITIVE, SHARE

METHOD = "weighted_knn"


def by_fingerprints(config: DictConfig) -> Localisation:
    """Locate rows of a file by its others, or rows of another file.

    Args:
        config: see conf/locate.yaml.

    Raises:
        ValueError: no file, a checkpoint as well, or settings that only a trained model has.
    """
    chosen, seed, groups = config.dataset, int(config.seed), int(config.calibrate)
    if chosen.file is None or not OmegaConf.is_missing(config, "ckpt"):
        raise ValueError("dataset=fingerprints learns from its own rows: give dataset.file=FILE, and no ckpt")
    if config.offset_db is not None or config.plan is not None or config.prior != "box":
        raise ValueError("offset_db, plan, prior: of trained models alone, not of fingerprints")
    POSITIVE.check("dataset.side_m", chosen.side_m)
    SHARE.check("dataset.held_out", chosen.held_out)
    rows = read_fingerprints(chosen.file)
    how: Any = "file" if config.data else chosen.split
    cut = float(chosen.side_m), float(chosen.held_out)
    if config.data:
        known, heard = rows, read_fingerprints(config.data, False).of_access_points(rows.access_point)
    else:
        known, heard = map(rows.at, parted(rows, how, *cut, seed))
    heard = heard.at(sample(config, len(heard.level)))
    place, each_ms, fit_s = located_by(METHOD, as_snapshots(known), as_snapshots(heard))
    facts = {
        "dataset/name": Path(chosen.file).stem, "dataset/sha256": sha256(rows.level.tobytes()).hexdigest(),
        "split/name": how, "split/train": len(known.level), "time/fit_s": fit_s, "locate/calibrated_on": 0,
    }  # fmt: skip
    promise, radius = "nothing is promised without calibration, or of another campaign", None
    if groups:
        # Held-out rows promise something only of rows drawn as they are.
        random, share = how in ("random", "places", "blocks", "walks"), float(config.share)
        errors = left_out(known, how if random else "places", cut, groups, seed)
        facts["locate/calibrated_on"], radius = len(errors), reach(errors, share)
        promise = f"{share:.0%} are promised" if random else promise
    true = heard.position if np.isfinite(heard.position).all() else None
    about, inside = dict[str, list[Any]](), None
    if radius is not None:
        about = {"area_m2": [np.pi * radius**2] * len(place)}
        inside = None if true is None else np.linalg.norm(place - true, axis=1) <= radius
    return Localisation(
        METHOD, place, as_snapshots(heard), as_snapshots(known), np.zeros(3), true is not None, about,
        inside, each_ms, promise, facts,
    )  # fmt: skip


def left_out(rows: Fingerprints, how: Any, cut: tuple[float, float], groups: int, seed: int) -> np.ndarray:
    """Return errors (n,) [m] of a few groups of rows placed by the others; `how` and `cut` as of `parted`."""
    errors = []
    for number in range(groups):
        train, test = parted(rows, how, *cut, seed + 1 + number)
        test = np.random.default_rng(seed).permutation(test)[: -(-HELD_OUT // groups)]
        place, *_ = located_by(METHOD, as_snapshots(rows.at(train)), as_snapshots(rows.at(test)))
        errors.append(np.linalg.norm(place - rows.position[test], axis=1))
    return np.concatenate(errors)


def reach(errors: np.ndarray, share: float) -> float | None:
    """Return a radius [m] that holds a `share` of errors like these (n,); None where they are too few."""
    # Of n exchangeable errors and one more the ceil((n + 1) share)-th.
    rank = int(np.ceil((len(errors) + 1) * share))
    return float(np.sort(errors)[rank - 1]) if rank <= len(errors) else None


def as_snapshots(rows: Fingerprints) -> Snapshots:
    """Return rows as snapshots of powers."""
    values = torch.from_numpy(rows.level).double()
    return Snapshots("rssi", values, None, rows.position, np.arange(len(values)))
