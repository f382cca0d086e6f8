"""Fingerprints, levels of access points whose places nobody knows, placed by the nearest rows."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from gsparc.apps.locate.judging import Report, columns_of_places, report, sample_rows
from gsparc.apps.locate.neighbours import locate_by_neighbours
from gsparc.apps.locate.snapshots import Scans
from gsparc.base.limits import POSITIVE, SHARE
from gsparc.datasets.fingerprints import Fingerprints, read_fingerprints, split_fingerprints

METHOD = "weighted_knn"


def locate_fingerprints(config: DictConfig, run_dir: Path) -> Report:
    """Locate and report on rows of a file by its others, or rows of another file.

    Args:
        config: see conf/locate.yaml.
        run_dir: of `locate.csv`.

    Raises:
        ValueError: no file, a checkpoint as well, or settings that only a trained model has.
    """
    chosen = config.dataset
    if chosen.file is None or not OmegaConf.is_missing(config, "ckpt"):
        raise ValueError(
            "dataset=fingerprints learns from its own rows: give dataset.file=FILE, and no ckpt"
        )
    if config.offset_db is not None or config.plan is not None or config.prior != "box":
        raise ValueError("offset_db, plan, prior: for trained models alone, not for fingerprints")
    POSITIVE.check("dataset.side_m", chosen.side_m)
    SHARE.check("dataset.held_out", chosen.held_out)
    rows = read_fingerprints(chosen.file)
    how: Any = "file" if config.data else chosen.split
    if config.data:
        reference, heard = (
            rows,
            read_fingerprints(config.data, False).select_access_points(rows.access_point),
        )
    else:
        reference, heard = map(
            rows.subset,
            split_fingerprints(
                rows, how, float(chosen.side_m), float(chosen.held_out), int(config.seed)
            ),
        )
    heard = heard.subset(sample_rows(config, len(heard.level)))
    both = fingerprint_snapshots(heard), fingerprint_snapshots(reference)
    place, query_ms, fit_s = locate_by_neighbours(METHOD, *both[::-1])
    facts = {
        "dataset/name": Path(chosen.file).stem,
        "dataset/sha256": sha256(rows.level.tobytes()).hexdigest(),
        "split/name": how,
        "split/train": len(reference.level),
        "time/fit_s": fit_s,
        "time/locate_ms": query_ms,
    }
    return report(run_dir, config, METHOD, *both, columns_of_places(place, heard.position), facts)


def fingerprint_snapshots(rows: Fingerprints) -> Scans:
    """Return rows as snapshots of powers."""
    return Scans("rssi", torch.from_numpy(rows.level).double(), None, rows.position)
