"""`gsparc locate ckpt=FILE`: where its test rows, or the rows of another file, were heard."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.map import plan_of
from gsparc.commands.output import finish, run_directory
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.limits import POSITIVE, SHARE, choice, number, or_null, switch, whole
from gsparc.data.load import split_settings
from gsparc.data.own import interpreted
from gsparc.data.raw import read_raw
from gsparc.data.schema import Measurements
from gsparc.evaluation.localisation import draw_errors, draw_posteriors
from gsparc.evaluation.open_runs import Opened, aligned, open_files
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import table, write_samples
from gsparc.locate import locator as locating
from gsparc.locate.baselines.table import BASELINES, located_by
from gsparc.locate.cells import Cells, cover
from gsparc.locate.fingerprints.locator import SHARED, FingerprintLocator, as_snapshots, trusted
from gsparc.locate.fingerprints.rows import parted, read_fingerprints
from gsparc.locate.likelihood import Trust
from gsparc.locate.locator import Located, Locator
from gsparc.locate.search import Unknown
from gsparc.locate.snapshots import Snapshots, snapshots
from gsparc.locate.track import followed
from gsparc.models import checkpoint
from gsparc.models.registry import build
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

LIMITS = {
    "prior": choice("box", "trained"), "share": SHARE, "offset_db": or_null(number(0)), "track": switch(),
    "calibrate": whole(0), "calibrate_s": POSITIVE, "rows": or_null(whole(1)), "phase_known": switch(),
}  # fmt: skip
DEVICES_DB = 6.0  # deviation of what receivers of one building add to all levels


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    return locate(config, run_directory())


def locate(config: DictConfig, run_dir: Path) -> dict[str, Any]:
    """Locate as conf/locate.yaml says, into a folder; returns the facts of its `summary.json`."""
    RunSettings.of(config)
    for name, limit in LIMITS.items():
        limit.check(name, config[name])
    for name in config.against:
        choice(*BASELINES).check("against", name)
    if config.dataset.name == "fingerprints":
        return _fingerprints(config, run_dir)
    run = open_files([config.ckpt], plain(config.dataset), plain(config.split))
    data, fold, method = run.data, run.split.folds[0], run.methods[0]
    learned = np.sort(np.concatenate([fold.train, fold.val]))
    unknown = Unknown(bool(config.phase_known), float(config.offset_db or 0))
    share = float(config.share)
    start = Trust() if config.calibrate else locating.restored(run.stored[0].extra, unknown, share)
    plan = plan_of(config)
    cells = partial(
        cover, most=locating.MOST, around=config.prior == "trained",
        open_at=None if plan is None else lambda places: plan.light(places[:, :2] + data.site.origin[:2]),
    )  # fmt: skip
    found = Locator.of(method, data, learned, unknown, start, cells, share)
    count = 0
    if config.calibrate:
        found, count = _calibrated(config, run, found, cells, run_dir)
        if config.store:
            checkpoint.amend(config.ckpt, locating.kept(found.trust, unknown, found.share))
    heard, known = _heard(config, run, data, fold)
    located = found.locate(heard)
    alone, level, trained = located, found.trust.level, snapshots(data, learned)
    promise = f"{found.share:.0%} are promised"
    if config.track:
        located, promise = followed(alone, trained, heard, level), "of a track nothing is promised"
    answers = {method.name: located} | ({"alone": alone} if config.track else {})
    facts = {**run.facts(), "locate/calibrated_on": count}
    return _report(config, run_dir, facts, answers, heard, trained, data.site.origin, known, level, promise)


def _report(
    config: DictConfig, run_dir: Path, facts: dict[str, Any], answers: Mapping[str, list[Located]],
    heard: Snapshots, trained: Snapshots, origin: np.ndarray, known: bool, level: float, promise: str,
) -> dict[str, Any]:  # fmt: skip
    """Table, pictures and facts of answers, the first of which is ours; errors where places are known."""
    ours, located = next(iter(answers.items()))
    inside = [one.posterior.level(p) <= level for one, p in zip(located, heard.place, strict=True)]
    write_samples(run_dir / "locate.csv", _columns(located, heard, origin, inside, known))
    facts |= {"locate/snapshots": len(heard), "locate/track": int(config.track)}
    facts |= {"locate/area_m2": float(np.median([one.area for one in located]))}
    facts |= {"time/locate_ms_p50": float(np.median([one.seconds for one in located]) * 1e3)}
    shown_at = [locating.in_world(one, origin) for one in located]
    true = heard.place + origin if known else None
    draw_posteriors(shown_at, true, trained.place + origin, run_dir / "posteriors.png")
    if not known:
        return finish(run_dir, facts)
    errors = {
        name: np.linalg.norm(np.array([one.place for one in found]) - heard.place, axis=1)
        for name, found in answers.items()
    }
    for name in config.against:
        stem = f"baseline/{name}"
        place, facts[f"{stem}/locate_ms"], facts[f"time/{stem}/fit_s"] = located_by(name, trained, heard)
        errors[name] = np.linalg.norm(place - heard.place, axis=1)
    facts |= {"locate/coverage": float(np.mean(inside))}
    for name, values in errors.items():
        stem = "locate" if name == ours else f"locate/{name}" if name in answers else f"baseline/{name}"
        facts |= {
            f"{stem}/{key}": float(np.quantile(values, q)) for key, q in (("median_m", 0.5), ("p90_m", 0.9))
        }
    draw_errors(errors, run_dir / "errors.png")
    rows = [[name, *(f"{np.quantile(v, q):.3g}" for q in (0.5, 0.9))] for name, v in errors.items()]
    title = f"{facts['dataset/name']}, {len(heard)} snapshots"
    shown = table(title, ["method"], ["median [m]", "p90 [m]"], rows)
    said = (
        f"areas of {facts['locate/area_m2']:.3g} m2 (median) hold {np.mean(inside):.0%} of places, "
        f"{promise}; {facts['time/locate_ms_p50']:.3g} ms a snapshot"
    )
    return finish(run_dir, facts, shown, lines=[said])


def _fingerprints(config: DictConfig, run_dir: Path) -> dict[str, Any]:
    """A field of fingerprints is learned, and rows that it did not learn from are located."""
    chosen, seed, groups = config.dataset, int(config.seed), int(config.calibrate)
    if chosen.file is None or not OmegaConf.is_missing(config, "ckpt"):
        raise ValueError("dataset=fingerprints learns its own field: give dataset.file=FILE, and no ckpt")
    POSITIVE.check("dataset.side_m", chosen.side_m)
    SHARE.check("dataset.held_out", chosen.held_out)
    rows = read_fingerprints(chosen.file)
    if config.track and not rows.time_s.any():
        raise ValueError(f"track=true: {chosen.file} does not say when its rows were heard (time_s)")
    how: Any = "file" if config.data else chosen.split
    cut = float(chosen.side_m), float(chosen.held_out)
    if config.data:
        known, heard = rows, read_fingerprints(config.data, False).of_access_points(rows.access_point)
    else:
        known, heard = map(rows.at, parted(rows, how, *cut, seed))
    heard = heard.at(_drawn(config, len(heard.level)))
    offset = DEVICES_DB if config.offset_db is None else float(config.offset_db)
    started = time.perf_counter()
    locator = FingerprintLocator.of(known, offset, config.prior == "trained", bool(config.track))
    facts = {
        "dataset/name": Path(chosen.file).stem, "dataset/sha256": sha256(rows.level.tobytes()).hexdigest(),
        "split/name": how, "split/train": len(known.level), "locate/calibrated_on": 0,
        "time/fit_s": time.perf_counter() - started,
    }  # fmt: skip
    promise = "nothing is promised without calibration, or of another campaign"
    if groups:
        drawn, share = how in ("random", "places", "blocks", "walks"), float(config.share)
        inner: Any = how if drawn else "places"
        locator, facts["locate/calibrated_on"] = trusted(locator, known, inner, *cut, groups, share, seed)
        promise = f"{share:.0%} are promised" if drawn else promise
    answers = {"field": locator.locate(heard)}
    if config.track:
        answers["alone"] = replace(locator, speed=None, point=SHARED).locate(heard)
    both, placed = (as_snapshots(heard), as_snapshots(known)), bool(np.isfinite(heard.position).all())
    return _report(config, run_dir, facts, answers, *both, np.zeros(3), placed, locator.area.level, promise)


def _drawn(config: DictConfig, count: int) -> np.ndarray:
    """Numbers of at most `rows` of so many rows, drawn evenly."""
    if not count:
        raise ValueError("there is nothing to be located")
    return np.sort(np.random.default_rng(int(config.seed)).permutation(count)[: config.rows])


def _calibrated(
    config: DictConfig, run: Opened, found: Locator, cells: Callable[[np.ndarray], Cells], run_dir: Path
) -> tuple[Locator, int]:
    settings = OmegaConf.create(run.stored[0].configuration)
    if "model" not in settings:
        raise ValueError(f"{config.ckpt} does not name its settings: calibrate=0 goes without")
    split = settings.get("split")
    context = FitContext(
        run_dir=run_dir / "left_out", seed=int(config.seed), budget_s=float(config.calibrate_s),
        split=None if split is None else split_settings(plain(split)),
        stations=settings.get("stations", "auto"),
    )  # fmt: skip
    make = partial(build, settings.model)
    trust, count = locating.trusted(
        make, run.data, run.split.folds[0], context, found, int(config.calibrate), cells
    )
    log.info("trust learned from %d snapshots that were left out: %s", count, trust)
    return Locator(found.field, found.cells, found.unknown, trust, found.share), count


def _heard(config: DictConfig, run: Opened, data: Measurements, fold: Any) -> tuple[Snapshots, bool]:
    """The snapshots, and whether their places are known."""
    known = True
    if config.data is None:
        heard = snapshots(data, rows_of(fold, config.eval_on))
    else:
        raw, place = read_raw(config.data), f"{data.site.moving_end}_position"
        known = place in raw.arrays
        if not known:  # anywhere: nothing is compared with it
            count = max(len(raw.arrays.get(data.site.kind, ())), len(raw.arrays.get("rssi_db", ())))
            low, high = data.site.moving_box + data.site.origin
            raw.arrays[place] = np.linspace(low, high, count)
        other = aligned(interpreted(raw, config.data), data.site)
        heard = snapshots(other, np.arange(len(other)))
    heard = heard.at(_drawn(config, len(heard)))
    return heard, known


def _columns(
    located: list[Located], heard: Snapshots, origin: np.ndarray, inside: list[bool], known: bool
) -> dict[str, list[Any]]:
    """Of `locate.csv`, in the world's coordinates [m]."""
    place = np.array([one.place for one in located])
    found = {axis: (place + origin)[:, i].tolist() for i, axis in enumerate("xyz")}
    if known:
        found |= {f"{axis}_true": (heard.place + origin)[:, i].tolist() for i, axis in enumerate("xyz")}
        found |= {"error_m": np.linalg.norm(place - heard.place, axis=1).tolist()}
    found |= {"area_m2": [one.area for one in located]}
    found |= {"inside": [int(one) for one in inside]} if known else {}
    return {**found, "modes": [one.modes for one in located]}
