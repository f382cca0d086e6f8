"""`gsparc locate ckpt=FILE`: where its test rows, or the rows of another file, were heard."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.map import plan_of
from gsparc.commands.output import finish, run_directory
from gsparc.commands.settings import RunSettings, plain
from gsparc.data.load import split_settings
from gsparc.data.own import interpreted
from gsparc.data.raw import read_raw
from gsparc.data.schema import Measurements
from gsparc.evaluation.localisation import draw_errors, draw_posteriors
from gsparc.evaluation.open_runs import Opened, aligned, open_files
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import table, write_samples
from gsparc.locate import locator as locating
from gsparc.locate.baselines.table import located_by
from gsparc.locate.cells import Cells, cover
from gsparc.locate.likelihood import Trust
from gsparc.locate.locator import Located, Locator
from gsparc.locate.search import Unknown
from gsparc.locate.snapshots import Snapshots, snapshots
from gsparc.models import checkpoint
from gsparc.models.registry import build
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

PRIORS = ("box", "trained")


def task(config: DictConfig) -> dict[str, Any]:
    """What the command does; returns the facts it wrote to `summary.json` in the run directory."""
    RunSettings.of(config)
    if config.prior not in PRIORS:
        raise ValueError(f"prior={config.prior}: one of {', '.join(PRIORS)} is needed")
    if not 0 < config.share < 1:
        raise ValueError(f"share={config.share}: a number between 0 and 1 is needed")
    if config.offset_db < 0:
        raise ValueError(f"offset_db={config.offset_db}: a standard deviation of at least 0 is needed")
    run_dir = run_directory()
    run = open_files([config.ckpt], plain(config.dataset), plain(config.split))
    data, fold, method = run.data, run.split.folds[0], run.methods[0]
    learned = np.sort(np.concatenate([fold.train, fold.val]))
    unknown = Unknown(bool(config.phase_known), float(config.offset_db))
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
        found, count = _calibrated(config, run, found, cells)
        if config.store:
            checkpoint.amend(config.ckpt, locating.kept(found.trust, unknown, found.share))
    heard, known = _heard(config, run, data, fold)
    located = found.locate(heard)
    inside = [
        one.posterior.level(p) <= found.trust.level for one, p in zip(located, heard.place, strict=True)
    ]
    error = np.linalg.norm(np.array([one.place for one in located]) - heard.place, axis=1)
    write_samples(run_dir / "locate.csv", _columns(located, heard, data, error, inside, known))
    facts = {**run.facts(), "locate/calibrated_on": count, "locate/snapshots": len(heard)}
    facts |= {"locate/area_m2": float(np.median([one.area for one in located]))}
    facts |= {"time/locate_ms_p50": float(np.median([one.seconds for one in located]) * 1e3)}
    origin = data.site.origin
    shown_at = [locating.in_world(one, origin) for one in located]
    true = heard.place + origin if known else None
    draw_posteriors(shown_at, true, data.moving[learned] + origin, run_dir / "posteriors.png")
    if not known:
        return finish(run_dir, facts)
    errors = {method.name: error}
    trained = snapshots(data, learned)
    for name in config.against:
        place, facts[f"baseline/{name}/locate_ms"] = located_by(name, trained, heard)
        errors[name] = np.linalg.norm(place - heard.place, axis=1)
    facts |= {"locate/coverage": float(np.mean(inside))}
    for name, values in errors.items():
        stem = "locate" if name == method.name else f"baseline/{name}"
        facts |= {
            f"{stem}/{key}": float(np.quantile(values, q)) for key, q in (("median_m", 0.5), ("p90_m", 0.9))
        }
    draw_errors(errors, run_dir / "errors.png")
    rows = [[name, *(f"{np.quantile(v, q):.3g}" for q in (0.5, 0.9))] for name, v in errors.items()]
    title = f"{data.site.name}, {len(heard)} snapshots"
    shown = table(title, ["method"], ["median [m]", "p90 [m]"], rows)
    said = (
        f"areas of {facts['locate/area_m2']:.3g} m2 (median) hold {np.mean(inside):.0%} of places, "
        f"{found.share:.0%} are promised; {facts['time/locate_ms_p50']:.3g} ms a snapshot"
    )
    return finish(run_dir, facts, shown, lines=[said])


def _calibrated(
    config: DictConfig, run: Opened, found: Locator, cells: Callable[[np.ndarray], Cells]
) -> tuple[Locator, int]:
    settings = OmegaConf.create(run.stored[0].configuration)
    if "model" not in settings:
        raise ValueError(f"{config.ckpt} does not name its settings: calibrate=0 goes without")
    split = settings.get("split")
    context = FitContext(
        run_dir=run_directory() / "left_out", seed=int(config.seed), budget_s=float(config.calibrate_s),
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
    if not len(heard):
        raise ValueError("there is nothing to be located")
    if config.rows is not None and len(heard) > config.rows:
        chosen = np.random.default_rng(int(config.seed)).permutation(len(heard))[: int(config.rows)]
        heard = heard.at(np.sort(chosen))
    return heard, known


def _columns(
    located: list[Located], heard: Snapshots, data: Measurements, error: np.ndarray, inside: list[bool],
    known: bool,
) -> dict[str, list[Any]]:  # fmt: skip
    """Of `locate.csv`, in the world's coordinates [m]."""
    place = np.array([one.place for one in located]) + data.site.origin
    found = {axis: place[:, i].tolist() for i, axis in enumerate("xyz")}
    if known:
        true = heard.place + data.site.origin
        found |= {f"{axis}_true": true[:, i].tolist() for i, axis in enumerate("xyz")}
        found |= {"error_m": error.tolist()}
    found |= {"area_m2": [one.area for one in located]}
    found |= {"inside": [int(one) for one in inside]} if known else {}
    return {**found, "modes": [one.modes for one in located]}
