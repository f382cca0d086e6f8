"""`gsparc study kind=effects|positions|measurements`: variants of one model, and baselines, on the same data.

Leaves `study.csv`, `study.png` and `summary.json`, whose `study/<variant>[/<what>/<amount>]/*` hold the
accuracy under its own name, seconds of training and milliseconds of a query.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from gsparc.commands.shared.output import finish, run_directory
from gsparc.commands.shared.settings import RunSettings, plain
from gsparc.data.load import load, split_for
from gsparc.evaluation.evaluate import dataset_facts, split_facts
from gsparc.evaluation.experiment.done import State, content
from gsparc.evaluation.experiment.folds import fit_context
from gsparc.evaluation.experiment.pictures import draw_study
from gsparc.evaluation.experiment.study import Study, facts_of
from gsparc.evaluation.summary import TRAIN_S, run_conditions, shown, table, write_samples
from gsparc.models.method import MethodFactory
from gsparc.models.registry import build, method_class
from gsparc.prediction.timing import ClockSettings, machine_facts


def variants_of(config: DictConfig) -> dict[str, Callable[[], MethodFactory]]:
    """Return those of `config.variants`, overrides of `config.model`, then `config.baselines` by name."""

    # Resolved first: an interpolation would take the place of the model's own settings, not join them.
    variants = {
        str(name): partial(build, OmegaConf.merge(config.model, overrides))  # type: ignore[arg-type]
        for name, overrides in plain(config.variants).items()
    }
    return variants | {name: method_class(name) for name in config.baselines}


def study_of(config: DictConfig) -> Study:
    """Return the study that a composed configuration describes."""
    return Study(
        variants_of(config),
        instantiate(config.kind).conditions(),
        int(config.rounds),
        int(config.seed),
        ClockSettings(rounds=int(config.queries), budget_s=float(config.query_s)),
    )


def task(config: DictConfig) -> pd.DataFrame:
    """Run the study, show its table, write its files."""
    settings = RunSettings.of(config)
    build(config.model)  # its parts check themselves
    run_dir = run_directory()
    study = study_of(config)
    data = load(plain(config.dataset))
    split = split_for(plain(config.split), data)
    try:
        # Rounds that were done on other data, splits or settings do not count as these.
        state = State.of(config, content(data), split.sha256)
        rows = study.run(data, split, fit_context(config, run_dir=run_dir), state)
    except KeyboardInterrupt:  # whose advice is that of a training
        message = f"the study was interrupted; hydra.run.dir={run_dir} goes on after the rounds that are done"
        raise KeyboardInterrupt(message) from None
    facts: dict[str, Any] = {
        **dataset_facts(data), **split_facts(split),
        "seed": settings.seed, "study/rounds": study.rounds, **facts_of(rows),
    }  # fmt: skip
    title = f"{data.site.name}, split {split.name}: {instantiate(config.kind).title}"
    write_samples(run_dir / "study.csv", rows.to_dict("list"))
    draw_study(rows, title, run_dir / "study.png")
    finish(run_dir, facts, table_of(rows, title), lines=run_conditions(facts | machine_facts()))
    return rows


def table_of(rows: pd.DataFrame, title: str) -> Table:
    """Return a table with a line per row; conditions where the study has any."""
    changed = (rows.what != "none").any()
    costs = {
        "train_s": TRAIN_S, "train_cpu_s": "cpu s/fold", "query_ms": "query ms", "query_p95_ms": "p95"
    }  # fmt: skip
    lines = []
    for row in rows.to_dict("records"):
        change = row["what"] if row["what"] == "none" else f"{row['what']} {row['amount']:g}"
        value = f"{row['value']:.4g}" + ("" if pd.isna(row["spread"]) else f" ± {row['spread']:.2g}")
        words = [row["variant"], row["effects"], *([change] if changed else [])]
        lines.append([*words, f"{row['rows']:g}", value, *(shown(row[name], ".3g") for name in costs)])
    words = ["variant", "effects", *(["changed"] if changed else [])]
    numbers = ["rows", rows.figure.iloc[0], *costs.values()]
    return table(title, words, numbers, lines)
