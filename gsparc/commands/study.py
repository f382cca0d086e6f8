"""`gsparc study kind=effects|positions|measurements`: variants of one model, and baselines, on the same data.

Leaves `study.csv`, a row a variant and condition (`study.ROW`), `study.png` and `summary.json`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.commands.shared.output import finish_run, run_directory
from gsparc.commands.shared.settings import RunSettings, to_dict
from gsparc.data.load import load, split_for
from gsparc.evaluation.evaluate import dataset_facts, split_facts
from gsparc.evaluation.experiment.folds import fit_context
from gsparc.evaluation.experiment.pictures import draw_study
from gsparc.evaluation.experiment.study import Condition, Study
from gsparc.evaluation.ledger import State, measurements_hash
from gsparc.evaluation.summary import run_conditions, write_samples
from gsparc.evaluation.table import CPU, P50, P95, TRAIN, Column, Table, value_with_error
from gsparc.models.method import MethodFactory
from gsparc.models.registry import build, method_class
from gsparc.prediction.timing import ClockSettings, machine_facts


def variants_of(config: DictConfig) -> dict[str, Callable[[], MethodFactory]]:
    """Return those of `config.variants`, overrides of `config.model`, then `config.baselines` by name."""

    # Resolved first: an interpolation would take the place of the model's own settings, not join them.
    variants = {
        str(name): partial(build, OmegaConf.merge(config.model, overrides))  # type: ignore[arg-type]
        for name, overrides in to_dict(config.variants).items()
    }
    return variants | {name: method_class(name) for name in config.baselines}


def study_of(config: DictConfig) -> Study:
    """Return the study that a composed configuration describes."""
    return Study(
        variants_of(config),
        instantiate(config.kind).conditions(),
        int(config.rounds),
        int(config.seed),
        ClockSettings(rounds=int(config.queries), rounds_s=float(config.query_s)),
    )


def task(config: DictConfig) -> pd.DataFrame:
    """Run the study, show its table, write its files."""
    settings = RunSettings.from_config(config)
    build(config.model)  # its parts check themselves
    run_dir = run_directory()
    study = study_of(config)
    data = load(to_dict(config.dataset))
    split = split_for(to_dict(config.split), data)
    try:
        # Rounds that were done on other data, splits or settings do not count as these.
        state = State.from_config(config, measurements_hash(data), split.sha256)
        rows = study.run(data, split, fit_context(config, run_dir=run_dir), state)
    except KeyboardInterrupt:  # whose advice is that of a training
        message = f"the study was interrupted; hydra.run.dir={run_dir} goes on after the rounds that are done"
        raise KeyboardInterrupt(message) from None
    facts: dict[str, Any] = {
        **dataset_facts(data), **split_facts(split),
        "seed": settings.seed, "study/rounds": study.rounds,
    }  # fmt: skip
    title = f"{data.site.name}, split {split.title}: {instantiate(config.kind).title}"
    write_samples(run_dir / "study.csv", rows.to_dict("list"))
    draw_study(rows, title, run_dir / "study.png")
    finish_run(run_dir, facts, table_of(rows, title), lines=run_conditions(facts | machine_facts()))
    return rows


def table_of(rows: pd.DataFrame, title: str) -> Table:
    """Return a table with a line per row; conditions where the study has any."""
    changed = [Column("changed", "", of=lambda row: str(Condition(row["what"], row["amount"])))]
    words = [Column("variant", "", of="variant"), Column("effects", "", of="effects")]
    words += changed if (rows.what != "none").any() else []
    value = Column(rows.figure.iloc[0], of=value_with_error("value", "spread"))
    columns = [*words, Column("rows", "g", of="rows"), value, TRAIN, CPU, P50, P95]
    return Table.from_rows(title, columns, rows.to_dict("records"))  # type: ignore[arg-type]
