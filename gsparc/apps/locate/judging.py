"""Localisation by a trained model or by a field of fingerprints: places, errors, pictures."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from gsparc.apps.locate import locator as locating
from gsparc.apps.locate.baselines.table import located_by
from gsparc.apps.locate.cells import Cells, cover
from gsparc.apps.locate.fingerprints.locator import SHARED, FingerprintLocator, as_snapshots, trusted
from gsparc.apps.locate.likelihood import Trust
from gsparc.apps.locate.locator import Located, Locator
from gsparc.apps.locate.search import Unknown
from gsparc.apps.locate.snapshots import Snapshots, snapshots
from gsparc.apps.locate.track import followed
from gsparc.data.datasets.fingerprints import parted, read_fingerprints
from gsparc.data.errors import DataError
from gsparc.data.limits import POSITIVE, SHARE
from gsparc.data.own import interpreted
from gsparc.data.raw import read_raw
from gsparc.evaluation.console import plain
from gsparc.evaluation.drawing import logarithmic, look, panels, save
from gsparc.evaluation.open_runs import Opened, aligned, open_files
from gsparc.evaluation.scores import rows_of
from gsparc.evaluation.summary import table, write_samples
from gsparc.prediction.predictor import keep

log = logging.getLogger(__name__)

DEVICES_DB = 6.0  # deviation of what receivers of one building add to all levels
SHOWN = 6  # snapshots, evenly over all


@dataclass(frozen=True)
class Localisation:
    """Snapshots, and where each was heard.

    Attributes:
        answers: by method; the first is ours.
        heard, trained: what was located, and what was learned from.
        origin: (3,) of local coordinates [m].
        placed: whether the places of `heard` are known.
        level: mass of the areas.
        promise: what the areas promise, in words.
        facts: for the summary.
    """

    answers: dict[str, list[Located]]
    heard: Snapshots
    trained: Snapshots
    origin: np.ndarray
    placed: bool
    level: float
    promise: str
    facts: dict[str, Any]

    def columns(self, inside: Sequence[bool]) -> dict[str, Any]:
        """Return the columns of `locate.csv`, in the world's coordinates [m]."""
        located = next(iter(self.answers.values()))
        place, true = np.array([one.place for one in located]), self.heard.place
        columns: dict[str, Any] = dict(zip("xyz", (place + self.origin).T.tolist(), strict=True))
        if self.placed:
            columns |= dict(zip(("x_true", "y_true", "z_true"), (true + self.origin).T.tolist(), strict=True))
            columns |= {"error_m": np.linalg.norm(place - true, axis=1).tolist()}
        columns |= {"area_m2": [one.area for one in located]}
        columns |= {"inside": [int(one) for one in inside]} if self.placed else {}
        return {**columns, "modes": [one.modes for one in located]}


def report(
    result: Localisation, against: Sequence[str], run_dir: Path
) -> tuple[dict[str, Any], list[Table], list[str]]:
    """Write `locate.csv` and pictures; facts, and where places are known, a table and a sentence of errors.

    Args:
        result: what was located.
        against: names of plain methods beside it.
        run_dir: where files go.
    """
    (ours, located), heard, facts = next(iter(result.answers.items())), result.heard, dict(result.facts)
    inside = [one.posterior.level(p) <= result.level for one, p in zip(located, heard.place, strict=True)]
    write_samples(run_dir / "locate.csv", result.columns(inside))
    facts |= {
        "locate/snapshots": len(heard), "locate/track": int(len(result.answers) > 1),
        "locate/area_m2": float(np.median([one.area for one in located])),
        "time/locate_ms_p50": float(np.median([one.seconds for one in located]) * 1e3),
    }  # fmt: skip
    shown_at = [locating.in_world(one, result.origin) for one in located]
    true = heard.place + result.origin if result.placed else None
    draw_posteriors(shown_at, true, result.trained.place + result.origin, run_dir / "posteriors.png")
    if not result.placed:
        return facts, [], []
    places = {name: np.array([one.place for one in answers]) for name, answers in result.answers.items()}
    stems = {name: "locate" if name == ours else f"locate/{name}" for name in places}
    for name in against:
        stems[name] = stem = f"baseline/{name}"
        beside = located_by(name, result.trained, heard)
        places[name], facts[f"{stem}/locate_ms"], facts[f"time/{stem}/fit_s"] = beside
    errors = {name: np.linalg.norm(place - heard.place, axis=1) for name, place in places.items()}
    facts |= {"locate/coverage": float(np.mean(inside))}
    for name, values in errors.items():
        median, p90 = np.quantile(values, [0.5, 0.9])
        facts |= {f"{stems[name]}/median_m": float(median), f"{stems[name]}/p90_m": float(p90)}
    draw_errors(errors, run_dir / "errors.png")
    keys = ("median_m", "p90_m")
    rows = [[name, *(f"{facts[f'{stems[name]}/{key}']:.3g}" for key in keys)] for name in errors]
    title = f"{facts['dataset/name']}, {len(heard)} snapshots"
    sentence = (
        f"areas of {facts['locate/area_m2']:.3g} m2 (median) hold {np.mean(inside):.0%} of places, "
        f"{result.promise}; {facts['time/locate_ms_p50']:.3g} ms a snapshot"
    )
    return facts, [table(title, ["method"], ["median [m]", "p90 [m]"], rows)], [sentence]


def by_model(
    config: DictConfig, run_dir: Path, open_at: Callable[[np.ndarray], np.ndarray] | None
) -> Localisation:
    """Locate the test rows of a trained model, or those of a file.

    Args:
        config: see conf/locate.yaml.
        run_dir: of trainings that learn how far the model is trusted.
        open_at: which of places (n, 2) [m, world] one can stand at; None: everywhere.

    Raises:
        ValueError: the model states no variance, or does not name its settings.
    """
    run = open_files([config.ckpt], plain(config.dataset), plain(config.split))
    data, fold, method = run.data, run.split.folds[0], run.methods[0]
    learned = np.sort(np.concatenate([fold.train, fold.val]))
    unknown, share = Unknown(bool(config.phase_known), float(config.offset_db or 0)), float(config.share)
    # What was learned earlier for other settings is refused: its areas would hold another share.
    start = Trust() if config.calibrate else locating.restored(run.stored[0].extra, unknown, share)
    # A plan is in world metres, cells are local.
    east_north = data.site.origin[:2]
    light = None if open_at is None else lambda places: open_at(places[:, :2] + east_north)
    cells = partial(cover, most=locating.MOST, around=config.prior == "trained", open_at=light)
    locator, count = Locator.of(run.predictor, data.moving[learned], unknown, start, cells, share), 0
    if config.calibrate:
        trust, count = _trust(config, run, locator, cells, run_dir)
        locator = replace(locator, trust=trust)
        if config.store:
            keep(config.ckpt, locating.trust_state(trust, unknown, share))
    heard, placed = _snapshots(config, run)
    answers, trained = {method.name: locator.locate(heard)}, snapshots(data, learned)
    level, promise = locator.trust.level, f"{locator.share:.0%} are promised"
    if config.track:
        answers["alone"], promise = answers[method.name], "of a track nothing is promised"
        answers[method.name] = followed(answers["alone"], trained, heard, level)
    facts = {**run.facts(), "locate/calibrated_on": count}
    return Localisation(answers, heard, trained, data.site.origin, placed, level, promise, facts)


def _trust(
    config: DictConfig, run: Opened, locator: Locator, cells: Callable[[np.ndarray], Cells], run_dir: Path
) -> tuple[Trust, int]:
    """Learned from training rows that were left out, and their number."""
    brief = {"run_dir": run_dir / "left_out", "seed": int(config.seed), "budget_s": float(config.calibrate_s)}
    try:
        learned = run.retraining(**brief)
    except DataError as error:
        raise DataError(f"{error}: calibrate=0 goes without") from None
    result = locating.trusted(learned, locator, int(config.calibrate), cells)
    log.info("trust learned from %d snapshots that were left out: %s", result[1], result[0])
    return result


def _snapshots(config: DictConfig, run: Opened) -> tuple[Snapshots, bool]:
    """The snapshots, and whether their places are known."""
    site, placed = run.data.site, True
    if config.data is None:
        heard = snapshots(run.data, rows_of(run.split.folds[0], config.eval_on))
    else:
        raw, place = read_raw(config.data), f"{site.moving_end}_position"
        placed = place in raw.arrays
        if not placed:  # anywhere: nothing is compared with it
            count = max(len(raw.arrays.get(site.kind, ())), len(raw.arrays.get("rssi_db", ())))
            low, high = site.moving_box + site.origin
            # Any places will do, as rows must have some; a diagonal, so that no two are one.
            raw.arrays[place] = np.linspace(low, high, count)
        other = aligned(interpreted(raw, config.data), site)
        heard = snapshots(other, np.arange(len(other)))
    return heard.at(_sample(config, len(heard))), placed


def by_fingerprints(config: DictConfig) -> Localisation:
    """Learn a field of fingerprints, and locate rows that it did not learn from.

    Args:
        config: see conf/locate.yaml.

    Raises:
        ValueError: no file, a checkpoint as well, or rows that cannot be followed.
    """
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
    heard = heard.at(_sample(config, len(heard.level)))
    # Devices of one building differ by some 6 dB: an offset that is integrated out.
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
        # Held-out rows promise something only of rows drawn as they are.
        random, share = how in ("random", "places", "blocks", "walks"), float(config.share)
        inner: Any = how if random else "places"
        locator, facts["locate/calibrated_on"] = trusted(locator, known, inner, *cut, groups, share, seed)
        promise = f"{share:.0%} are promised" if random else promise
    answers = {"field": locator.locate(heard)}
    if config.track:
        answers["alone"] = replace(locator, speed=None, point=SHARED).locate(heard)
    both, placed = (as_snapshots(heard), as_snapshots(known)), bool(np.isfinite(heard.position).all())
    return Localisation(answers, *both, np.zeros(3), placed, locator.area.level, promise, facts)


def _sample(config: DictConfig, count: int) -> np.ndarray:
    """Numbers of at most `rows` of so many rows, drawn evenly."""
    if not count:
        raise ValueError("there is nothing to be located")
    # Sorted, since rows of a track must stay in the order of time.
    return np.sort(np.random.default_rng(int(config.seed)).permutation(count)[: config.rows])


def draw_posteriors(
    located: Sequence[Located], true: np.ndarray | None, trained: np.ndarray, path: Path
) -> None:
    """Masses of the cells of a few snapshots from above, as one PNG.

    `true` (n, 3) [m] in the coordinates of `located`, or None; `trained` (m, 3): places learned from.
    """
    some = np.unique(np.linspace(0, len(located) - 1, SHOWN).round().astype(int))
    columns = min(len(some), 3)
    figure, axes = panels(9, 3.2 * -(-len(some) // columns), -(-len(some) // columns), columns, grid=False)
    for axis in axes.flat[len(some) :]:
        axis.axis("off")
    for axis, number in zip(axes.flat, some, strict=False):
        one = located[number]
        cells, density = one.posterior.cells, one.posterior.log_density
        order = np.argsort(density)  # cells above one another: the likeliest is seen
        corners = cells.centre[order, :2] - cells.edge[order, :2] / 2
        boxes = [
            Rectangle((x, y), w, h) for (x, y), (w, h) in zip(corners, cells.edge[order, :2], strict=True)
        ]
        patches = PatchCollection(boxes, cmap="Blues", linewidth=0)
        # 12 below the largest, a factor of 160,000: what is fainter is no different from white.
        patches.set_array(np.maximum(density[order], density.max() - 12))
        axis.add_collection(patches)
        axis.plot(*trained[:, :2].T, ".", color="0.7", markersize=1, label="learned from")
        axis.plot(*one.place[:2], "x", color="#D55E00", label="located")
        if true is not None:
            axis.plot(*true[number, :2], "o", markerfacecolor="none", color="black", label="heard at")
        axis.set_aspect("equal")
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.set_title(f"snapshot {number}: {one.modes} mode{'s' if one.modes > 1 else ''}", fontsize=9)
    axes.flat[0].legend(fontsize=7)
    save(figure, path)


def draw_errors(errors: Mapping[str, np.ndarray], path: Path) -> None:
    """Share of snapshots located to within an error [m], a line a method, as one PNG."""
    figure, ((axis,),) = panels(6, 4)
    for name, values in errors.items():
        label = f"{name}, median {np.median(values):.3g} m"
        # .1 mm stands for no error at all on a logarithmic axis.
        axis.ecdf(np.maximum(values, 1e-4), color=look(name).colour, label=label)
    logarithmic(axis)
    axis.set(xlabel="error [m]", ylabel="share of snapshots", ylim=(0, 1))
    axis.legend(fontsize=8)
    save(figure, path)
