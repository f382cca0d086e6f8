"""Results of a run: `summary.json`, `per_sample.csv` and a table."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsparc.base.executor import SAY_S
from gsparc.base.files import write_samples, write_whole
from gsparc.evaluation.metric_formats import (
    BEST_SERVER,
    CALIBRATION,
    GIVEN_HEARD,
    LISTED,
    OF_KIND,
    OF_LISTS,
    WITH_SILENT,
    WITHOUT_OFF,
    judged_by,
    main_figure,
    number_format,
    score_of,
)
from gsparc.evaluation.paired import Lead
from gsparc.evaluation.results import facts_under, result_rows, row_of_method
from gsparc.evaluation.table import P50, TRAIN, Column, Table
from gsparc.models.registry import plain_methods
from gsparc.prediction.predictor import Predictor
from gsparc.training.cost import LINE

_Found = TypeVar("_Found")
# A load above 1 means waiting; 1.2 leaves room for what the machine does on its own.
MOST_LEARNED = 4  # notes of a fit below the table; the log has all
# Std wrong by a factor of two; 73 runs of public and simulated data had .6 to 2.2
RIGHT_CHI2 = 0.25, 4.0
BUSY = 1.2  # 1-minute load per core above which times are reported as inflated


def write_summary(path: str | Path, facts: Mapping[str, Any]) -> None:
    """Write flat `facts` as JSON, atomically; keys sorted.

    Raises:
        ValueError: a value is not a number, a string or None, or is NaN or infinite; the key is
            named.
    """
    # Sorted keys: summaries of two runs are compared line by line.
    text = json.dumps(
        {key: _value(key, facts[key]) for key in sorted(facts)}, indent=2, ensure_ascii=False
    )
    write_whole(path, text + "\n")


def write_as_found(
    found: Iterable[_Found], path: Path, columns: Callable[[list[_Found]], Any]
) -> list[_Found]:
    """Return all that is found; its columns are written meanwhile,
    so that an interrupt loses nothing.
    """
    so_far, written = list[_Found](), time.monotonic()
    try:
        for result in found:
            so_far.append(result)
            if time.monotonic() - written > SAY_S:
                write_samples(path, columns(so_far))
                written = time.monotonic()
    finally:
        if so_far:
            write_samples(path, columns(so_far))
    return so_far


def coordinates(places: np.ndarray, predictor: Predictor | None) -> dict[str, np.ndarray]:
    """Return columns of places (n, 3) [m], in degrees, too,
    where the model knows its place on Earth.
    """
    # Tenths of a millimetre here, about a millimetre in 1e-8 degrees.
    columns = dict(zip(("x", "y", "z"), places.T.round(4), strict=True))
    if predictor is not None and predictor.site.georeference is not None and len(places):
        latitude, longitude, _ = predictor.degrees(places)
        columns |= {"latitude": latitude.round(8), "longitude": longitude.round(8)}
    return columns


def results_table(
    facts: Mapping[str, Any], method: str, title: str = "", prefix: str = "test"
) -> Table:
    """Return every method as a row, accuracy beside its seconds and milliseconds;
    the last row is `method`'s.

    Args:
        facts: flat facts as in `summary.json`.
        method: name of the row with `facts[prefix/...]`.
        title: of the table.
        prefix: `test`, `train` or `val`.
    """
    # Silent rows, stations and variances are not of all data and methods.
    beside = [
        name for name in (WITH_SILENT, BEST_SERVER, CALIBRATION) if f"{prefix}/{name}" in facts
    ]
    wanted = [*OF_KIND[facts["dataset/kind"]].columns, "skill", *beside]
    method_row, *others = result_rows(facts, prefix)
    figures = [method_row.get(name) for name in wanted]
    # A baseline that the method is was fitted once: its row is the method's own.
    rivals = [
        o for o in others if o["method"] != method or [o.get(name) for name in wanted] != figures
    ]
    plain = plain_methods()
    rivals.sort(
        key=lambda row: plain.index(row["method"]) if row["method"] in plain else len(plain)
    )
    named = [
        row | {"method": f"{method} (baseline)"} if row["method"] == method else row
        for row in rivals
    ]
    alone = facts_under(facts, "field")
    fields = [row_of_method(f"{method}, Gaussians alone", alone, alone)] if alone else []
    figure_columns = (Column(name, number_format(name), of=name) for name in wanted)
    columns = [Column("method", "", of="method"), *figure_columns, TRAIN, P50]
    return Table.from_rows(
        title, columns, [*named, *fields, method_row | {"method": method}], bold=method
    )


def remarks(facts: Mapping[str, Any], prefix: str = "test") -> list[str]:
    """Return remarks on a table: rows that are not unseen, stand-ins, a busy machine,
    a baseline that is better.
    """
    seen = {
        "train": ["these are training rows: eval_on=test scores rows that were not learned from"],
        "val": [
            "methods, but not baselines, used these validation rows: compare methods with "
            "eval_on=test"
        ],
    }
    # Of a last fit `run_conditions` says what was scored.
    used = [] if facts.get("split/name") == "none" else seen.get(prefix, [])
    stated = [key.split("/") for key in facts if key.endswith(f"/{CALIBRATION}")]
    chi2 = {key[1]: facts["/".join(key)] for key in stated if key[0] == "baseline"}
    chi2[str(facts.get("model/label"))] = facts.get(f"{prefix}/{CALIBRATION}")
    wrong = describe_wrong_deviations(chi2, main_figure(facts, prefix))
    rest = describe_dominant_row(facts, prefix) + describe_best_baseline(facts, prefix) + wrong
    if above := facts.get(f"{prefix}/heard_above_db"):
        rest.append(
            f"{GIVEN_HEARD}: these rows do not name every station at each place. Levels as they "
            "are "
            f"(rssi_db of gsparc predict, maps) are {above:.1f} dB lower in the mean, with rmse_db "
            f"{facts[f'{prefix}/levels_rmse_db']:.2f} at these rows: compare them with levels of "
            "all cells "
            "(a scanner)"
        )
    if unlisted := facts.get(f"{prefix}/unlisted"):
        rest.append(f"cells that may be off: lists should hold them and none does: {unlisted}")
        without = {name: facts.get(f"{prefix}/{name}{WITHOUT_OFF}") for name in OF_LISTS}
        if cells := [
            f"{name} {value:{number_format(name)}}"
            for name, value in without.items()
            if value is not None
        ]:
            rest.append(f"figures above count these cells; without them: {', '.join(cells)}")
    if new := facts.get(f"{prefix}/new"):
        rest.append(f"new cells, which earlier lists should have held: {new}")
    folds = f" of all {facts['split/folds']} folds" if facts.get("split/folds", 1) > 1 else ""
    cost = [LINE.format(of_what=folds, cost=facts["time/cost"])] if facts.get("time/cost") else []
    lines = [*used, *run_conditions(facts), *rest, *describe_model(facts), *cost]
    # The candidate's name, as stored summaries have it, is no word for users.
    return [line.replace("joint_powers", "powers of all stations") for line in lines]


def describe_model(facts: Mapping[str, Any]) -> list[str]:
    """Return which method was chosen and what it is made of, then what it learned,
    of a law or of beams.
    """
    parts, label = facts.get("model/made"), facts.get("model/label")
    # `ImageSources` is said as image sources.
    kind = re.sub("(?<=[a-z])(?=[A-Z])", " ", str(facts.get("model/class") or "")).lower()
    texts = [] if parts in (None, label) else [parts if kind in parts else f"{kind}, {parts}"]
    # Notes of a method begin with its name, of which one is enough.
    notes = str(facts.get("model/learned") or "").replace(f"{facts.get('model/name')}: ", "")
    texts += notes.splitlines()[:MOST_LEARNED]
    lines = [f"  {text}" if number else f"{label}: {text}" for number, text in enumerate(texts)]
    folds = facts.get("split/folds") or 1
    return [f"of the first of {folds} folds:", *lines] if folds > 1 and lines else lines


def run_conditions(facts: Mapping[str, Any]) -> list[str]:
    """Say what limits figures: no test, stand-ins, rows that were learned from,
    and a busy machine.
    """
    conditions = []
    if facts.get("split/name") == "none" and not facts.get("split/test"):
        count = facts["split/train"] + facts["split/val"]
        conditions.append(f"nothing was tested: all {count} rows were learned from (split=none)")
        if any(key.startswith("val/") for key in facts):
            conditions[-1] += (
                f"; the table leaves {facts['split/val']} out, which had a say in settings only"
            )
    if facts.get("split/foreign"):
        conditions.append(f"the model was trained on {facts['split/foreign']}")
    if facts.get("split/without_baselines"):
        conditions.append(f"no baselines: {facts['split/without_baselines']}")
    if release := facts.get("dataset/stand_in"):
        conditions.append(
            f"SIMULATED stand-in: these figures do not describe the {release} release"
        )
    # A run that was not learned from has a phase that nothing tells:
    # its figure is of another question.
    if count := facts.get("split/unseen_runs"):
        conditions.append(
            f"{count} runs were not learned from: scored after the best common phase of each"
        )
    load = facts.get("machine/load")
    return conditions + describe_machine_load([] if load is None else [load])


def describe_machine_load(loads: Sequence[float]) -> list[str]:
    """Return that the machine was busy, where one of its 1-minute loads per core (n,) says so."""
    if max(loads, default=0.0) <= BUSY:
        return []
    ends = " to ".join(dict.fromkeys(f"{load:.1f}" for load in (min(loads), max(loads))))
    return [f"the machine was busy (load {ends} per core): times are inflated, ratios less so"]


def describe_dominant_row(facts: Mapping[str, Any], prefix: str = "test") -> list[str]:
    """Return the row that alone decides sums over all rows, if one does,
    and the median beside them.
    """
    row, name, share, median = (
        facts.get(f"{prefix}/decided_by/{key}") for key in ("row", "name", "share", "nmse_median")
    )
    if row is None:
        return []
    number = f"row {row}"  # as split.leave_out counts; the file may count otherwise
    called = number if name in (None, number) else f"{name} ({number} of split.leave_out)"
    return [
        f"{called} alone makes {share:.1%} of the error or power that nmse and mse add up: both "
        "describe "
        f"little else. The median row's NMSE is {median:.3g}"
    ]


def describe_wrong_deviations(chi2: Mapping[str, float | None], figure: str) -> list[str]:
    """Return methods whose `std` is wrong by a factor of two or more,
    by their reduced chi-squared, if any.

    >>> wrong = describe_wrong_deviations({"gp": 1.2, "field": 25.0, "mean": None}, "nmse")
    >>> wrong[0].split(": ")[1][:33]
    'std of field is 5 times too small'
    """
    low, high = RIGHT_CHI2
    # False for NaN: methods without a std have no such figure. 1e-12: answers may be exact.
    far = {n: max(x, 1e-12) for n, x in chi2.items() if x is not None and (x < low or x > high)}
    factors = [(n, max(x, 1 / x) ** 0.5, "large" if x < 1 else "small") for n, x in far.items()]
    faults = ", ".join(
        f"of {name} is {times:.2g} times too {side} ({CALIBRATION} {chi2[name]:.2g}, 1 is right)"
        for name, times, side in factors
    )
    tested = "gsparc map ckpt=FILE has tested intervals"
    if not figure.startswith("rmse"):  # for spectra and channels there are thresholds alone
        tested = "gsparc calibrate ckpt=FILE tests which answers to accept"
    meaning = f"stated uncertainty: std {faults}"
    return (
        [f"{meaning}; std orders predictions, but is no error bar here; {tested}"] if faults else []
    )


def describe_best_baseline(facts: Mapping[str, Any], prefix: str = "test") -> list[str]:
    """Return whether the best baseline beats the method, or neither; with silent rows,
    and of heard ones.

    Where cells may be off, of all others.
    """
    method, notes = str(facts.get("model/label") or facts.get("model/name")), list[str]()
    for ahead, figure in judged_by(facts, prefix).items():
        keys_of_baselines = [key for key in facts if key.startswith("baseline/")]
        end = WITHOUT_OFF * any(
            key.endswith(f"/{figure}{WITHOUT_OFF}") for key in keys_of_baselines
        )
        value = facts.get(f"{prefix}/{figure}{end}")
        keys = [key for key in keys_of_baselines if key.endswith(f"/{figure}{end}")]
        scores = {k.split("/")[1]: score_of(figure, facts[k]) for k in keys if facts[k] is not None}
        best = max(scores, key=lambda name: scores[name], default=None)
        if best is None or value is None:
            continue
        lead = Lead.from_facts(facts, f"baseline/{best}/{ahead}{end}")
        if lead is not None:
            judgements = judge_baseline(best, method, figure, lead, ahead == LISTED)
            without_cells = "without cells that may be off: " if end else ""
            notes += [f"{without_cells}{note}" for note in judgements]
        elif scores[best] > score_of(figure, value):
            notes.append(
                f"the baseline {best} has the better {figure} here; how surely is not known"
            )
    return notes


def judge_baseline(
    baseline: str, method: str, figure: str, lead: Lead, listed: bool = False
) -> list[str]:
    """Return whether a baseline, which has `lead` over a method, is significantly better, worse,
    or neither.

    Of `listed` rows alone it is no choice: lists hold what is strong,
    and which cells they hold is not known.
    """
    figure = f"{figure} of heard rows" if listed else figure
    if not lead.sure:
        return [f"the baseline {lead.no_difference(baseline, method, figure)}"]
    if lead.ahead_db < 0:
        return [f"{method} is {-lead} in {figure} than {baseline}, the best baseline"]
    choice = "" if listed else ": the better choice for this data and split"
    return [f"the baseline {baseline} is {lead} in {figure}{choice}"]


def _value(key: str, value: Any) -> int | float | str | None:
    value = value.item() if getattr(value, "ndim", None) == 0 else value  # NumPy and torch scalars
    # JSON's true is no number to programs that read figures.
    value = int(value) if isinstance(value, bool) else value
    if (
        value is None
        or isinstance(value, (int, str))
        or (isinstance(value, float) and math.isfinite(value))
    ):
        return value
    raise ValueError(
        f"summary: {key} is {value!r}; finite numbers, strings and null (undefined) are kept"
    )
