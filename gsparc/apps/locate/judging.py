"""Localisation by a trained model, or by the nearest fingerprints of stations that nobody knows the
places of: places, errors beside plain methods, a picture of posteriors.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle
from omegaconf import DictConfig, OmegaConf

from gsparc.apps.locate import locator as locating
from gsparc.apps.locate.locator import Located, Locator
from gsparc.apps.locate.neighbours import locate_by_neighbours
from gsparc.apps.locate.posterior import beyond_box, cover_box
from gsparc.apps.locate.search import Nuisances, Trust
from gsparc.apps.locate.snapshots import Scans, SiteField, group_snapshots
from gsparc.base.errors import DataError
from gsparc.base.files import write_samples
from gsparc.base.limits import POSITIVE, SHARE
from gsparc.datasets.fingerprints import Fingerprints, read_fingerprints, split_fingerprints
from gsparc.evaluation.console import to_dict
from gsparc.evaluation.summary import coordinates, write_as_found
from gsparc.evaluation.table import Column, Table
from gsparc.models import checkpoint
from gsparc.pictures.drawing import PALETTE, panels, save
from gsparc.prediction.predictor import Predictor
from gsparc.processes.few_rows import sample_row_numbers
from gsparc.runs.open_runs import Opened, open_run, read_like_stored

log = logging.getLogger(__name__)

Report = tuple[dict[str, Any], list[Table], list[str]]  # facts, tables and sentences
SHOWN = 6  # snapshots, evenly over all
ABOUT = ("modes", "doubt", "inside")  # columns of `Located`
# Of areas, by how many axes are searched
SIZES = {"length_m": "m", "area_m2": "m2", "volume_m3": "m3"}
TRUST_IS_OF = ("share", "prior", "plan", "plan_points")  # settings


def columns_of_places(
    world: np.ndarray, true: np.ndarray, predictor: Predictor | None = None
) -> dict[str, Any]:
    """Return columns of world places (n, 3) [m], and errors where `true` ones are not NaN."""
    columns = coordinates(world, predictor)
    if np.isnan(true).any():
        return columns
    columns |= {f"{axis}_true": values for axis, values in coordinates(true, None).items()}
    return columns | {"error_m": np.linalg.norm(world - true, axis=1)}


def report(
    run_dir: Path,
    config: DictConfig,
    method: str,
    heard: Scans,
    trained: Scans,
    columns: dict[str, Any],
    facts: dict[str, Any],
    promise: str = "",
    group: np.ndarray | None = None,
) -> Report:
    """Write `locate.csv`; facts, and where places are known, a table and a sentence of errors.

    Args:
        run_dir: where the file goes.
        config: see conf/locate.yaml.
        method: name.
        heard, trained: what was located, and what was learned from.
        columns: of `locate.csv`, n values each; `error_m` where true places are known, one of
            `SIZES` of areas.
        facts: for the summary, with the milliseconds of a snapshot.
        promise: what the areas promise, in words.
        group: see `locate_by_neighbours`.
    """
    write_samples(run_dir / "locate.csv", columns)
    size, inside = next((name for name in SIZES if name in columns), ""), columns.get("inside")
    facts["locate/snapshots"] = len(heard)
    facts |= {f"locate/{size}": float(np.median(columns[size]))} if size else {}
    doubts = _doubts(columns, facts)
    if "error_m" not in columns:
        return facts, [], doubts
    rows = []
    for name in dict.fromkeys([method, *config.against]):
        stem, error = "locate", columns["error_m"]
        if name != method:
            stem = f"baseline/{name}"
            place, *seconds = locate_by_neighbours(name, trained, heard, group)
            facts[f"{stem}/locate_ms"], facts[f"time/{stem}/fit_s"] = seconds
            error = np.linalg.norm(place - heard.place, axis=1)
        median, p90 = np.quantile(error, [0.5, 0.9]).tolist()
        facts |= {f"{stem}/median_m": median, f"{stem}/p90_m": p90}
        rows.append([name, median, p90])
    title = (
        f"{Path(config.data).stem if config.data else facts['dataset/name']}, {len(heard)} "
        "snapshots"
    )
    heads = Column("method", ""), Column("median [m]", ".3g"), Column("p90 [m]", ".3g")
    tables = [Table(title, heads, rows)]
    facts["locate/coverage"] = None if inside is None else float(np.mean(inside))
    if inside is not None:
        median = f"{facts[f'locate/{size}']:.3g} {SIZES[size]} (median)"
        areas = f"areas of {median} hold {np.mean(inside):.0%} of places"
        doubts.insert(0, f"{areas}, {promise}; {facts['time/locate_ms_p50']:.3g} ms a snapshot")
    return facts, tables, doubts


def _doubts(columns: dict[str, Any], facts: dict[str, Any]) -> list[str]:
    """A sentence on each doubt about areas; their counts go to `facts`."""
    doubt, lines = np.array(columns.get("doubt", []), str), []
    for key, why in locating.DOUBTS.items():
        facts[f"locate/{key}"] = count = int((doubt == why).sum())
        if count:
            reason = f"{why}: no promise for their areas (column doubt of locate.csv)"
            lines.append(f"{count} of {len(doubt)} snapshots are {reason}")
    if lines and "inside" in columns and (sure := doubt == "").any():
        share = np.mean(np.array(columns["inside"])[sure])
        lines.append(f"areas of the other {sure.sum()} hold {share:.0%} of places")
    return lines


def locate_by_model(
    config: DictConfig, run_dir: Path, open_at: Callable[[np.ndarray], np.ndarray] | None
) -> Report:
    """Locate and report on the test rows of a trained model, or those of a file.

    Args:
        config: see conf/locate.yaml.
        run_dir: of `locate.csv`, and of trainings that learn how far the model is trusted.
        open_at: which of places (n, 2) [m, world] one can stand at; None: everywhere.

    Raises:
        ValueError: the model states no variance, or does not name its settings.
    """
    run = open_run(config.ckpt, to_dict(config.dataset)).read(to_dict(config.split))
    data, fold = run.data, run.split.folds[0]
    learned = np.sort(fold.learned())
    unknown, share = (
        Nuisances(bool(config.phase_known), float(config.offset_db or 0)),
        float(config.share),
    )
    # A plan is in world metres, cells are local.
    origin = data.site.origin
    light = None if open_at is None else lambda places: open_at(places[:, :2] + origin[:2])
    cells = partial(cover_box, most=locating.MOST, around=config.prior == "trained", open_at=light)
    # First: a file that cannot be read needs no calibration
    heard, placed = _snapshots(config, run)
    box, wider = (
        cells(data.moving[learned][:, :3], beyond=beyond) for beyond in (0, locating.FURTHER)
    )
    size = list(SIZES)[(box.edge.max(0) > 0).sum() - 1]
    # Not of names alone: a plan's image, and rows, change under the same name.
    extra, cells_hash = (
        run.stored[0].extra,
        joblib.hash((box, wider, learned, data.site.sha256))[:8],
    )
    how = (
        {name: to_dict(config)[name] for name in TRUST_IS_OF}
        | asdict(unknown)
        | {"cells": cells_hash}
    )
    stored, other = extra.get(locating.KEY, {}), locating.find_other_settings(extra, how)
    anew = bool(config.calibrate and (config.renew or other))
    start, count = Trust() if anew else locating.restore_trust(extra, how), stored.get("count", 0)
    locator = Locator(SiteField(run.predictor), box, wider, unknown, start)
    if anew:
        if stored:
            log.info(
                "the stored calibration was of %s: it is done again",
                ", ".join(other) or "the same settings",
            )
        seed = int(config.seed)
        retraining = run.retraining(
            config.calibrate_effort, run_dir=run_dir / "left_out", seed=seed
        )
        trust, count = locating.learn_trust(
            retraining, locator, share, int(config.calibrate), cells
        )
        locator = replace(locator, trust=trust)
        if config.store:
            entry = {"trust": asdict(trust), "how": how, "count": count}
            checkpoint.update_extra(config.ckpt, {locating.KEY: entry})
    elif config.calibrate:
        log.info("calibrated before, on %d left-out snapshots; renew=true repeats it", count)

    def columns(located: Sequence[Located]) -> dict[str, Any]:
        first = slice(len(located))
        table = {} if heard.row is None else {"row": heard.row[first]}
        world = np.array([answer.place for answer in located]) + origin
        table |= columns_of_places(world, heard.place[first] + origin, run.predictor)
        about = {name: [getattr(answer, name) for answer in located] for name in ABOUT}
        about = {size: [answer.area for answer in located]} | about
        return table | {head: values for head, values in about.items() if values[0] is not None}

    located = write_as_found(locator.locate(heard), run_dir / "locate.csv", columns)
    trained = group_snapshots(data, learned)
    # Of which was warned
    status = "are promised" if config.calibrate or stored else "are not calibrated"
    claim = f"{share:.0%} {status}; {float(box.volume.sum()):.3g} {SIZES[size]} were searched"
    beyond = int(beyond_box(heard.place, box.box()).sum()) if placed else 0
    if beyond:
        claim += f", {beyond} true places lie outside"
    true = heard.place + origin if placed else None
    shown_at = [locating.to_world(answer, origin) for answer in located]
    draw_posteriors(shown_at, true, trained.place + origin, run_dir / "posteriors.png")
    query_ms = float(np.median([answer.seconds for answer in located]) * 1e3)
    facts = {**run.facts(), "locate/calibrated_on": count, "time/locate_ms_p50": query_ms}
    group = run.group_places(trained.place, int(config.calibrate) or 3, int(config.seed))
    return report(
        run_dir, config, run.methods[0].name, heard, trained, columns(located), facts, claim, group
    )


def _snapshots(config: DictConfig, run: Opened) -> tuple[Scans, bool]:
    """The snapshots, NaN for unknown places, and whether these are known."""
    placed, rows = True, None
    if config.data is None:
        data, rows = run.data, getattr(run.split.folds[0], config.eval_on)
        if not len(rows):
            which = f"eval_on={config.eval_on}: the split has no {config.eval_on} rows"
            raise DataError(f"{which}; say data=FILE of what is to be located, or eval_on=train")
    else:
        data, placed = read_like_stored(run.stored[0], config.data)
    heard = group_snapshots(data, np.arange(len(data)) if rows is None else rows)
    if not placed:
        log.info(
            "%s: %d snapshots in %d rows, at unknown places", config.data, len(heard), len(data)
        )
        heard = replace(heard, place=np.full_like(heard.place, np.nan))
    return heard.subset(sample_rows(config, len(heard))), placed


def sample_rows(config: DictConfig, count: int) -> np.ndarray:
    """Return numbers of at most `rows` of so many rows, drawn evenly."""
    if not count:
        raise ValueError("there is nothing to be located")
    # Sorted, since rows of a track must stay in the order of time.
    return sample_row_numbers(count, config.rows, int(config.seed))


def draw_posteriors(
    found: Sequence[Located], true: np.ndarray | None, known: np.ndarray, path: Path
) -> None:
    """Draw masses of the cells of a few snapshots from above, as one PNG.

    `true` (n, 3) [m] in the coordinates of `found`, or None; `known` (m, 3): places learned from.
    """
    some = np.unique(np.linspace(0, len(found) - 1, SHOWN).round().astype(int))
    columns = min(len(some), 3)
    figure, axes = panels(
        9, 3.2 * -(-len(some) // columns), -(-len(some) // columns), columns, grid=False
    )
    for axis in axes.flat[len(some) :]:
        axis.axis("off")
    for axis, number in zip(axes.flat, some, strict=False):
        answer = found[number]
        cells, density = answer.posterior.cells, answer.posterior.log_density
        order = np.argsort(density)  # cells above one another: the likeliest is seen
        corners = cells.centre[order, :2] - cells.edge[order, :2] / 2
        boxes = [Rectangle(*box) for box in zip(corners, *cells.edge[order, :2].T, strict=True)]
        # 12 below the largest, a factor of 160,000: what is fainter is no different from white.
        shade = np.maximum(density[order], density.max() - 12)
        axis.add_collection(PatchCollection(boxes, cmap="Blues", linewidth=0, array=shade))
        axis.plot(*known[:, :2].T, ".", color="0.7", markersize=1, label="learned from")
        axis.plot(*answer.place[:2], "x", color=PALETTE[1], label="located")
        if true is not None:
            axis.plot(
                *true[number, :2], "o", markerfacecolor="none", color="black", label="heard at"
            )
        axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axis.set_title(
            f"snapshot {number}: {answer.modes} mode{'s' if answer.modes > 1 else ''}", fontsize=9
        )
    axes.flat[0].legend(fontsize=7)
    save(figure, path)


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
