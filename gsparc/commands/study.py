"""`gsparc study kind=effects|positions|measurements`: variants of one model, and baselines,
on the same data.

Leaves `study.csv`, a row a variant and condition (`study.ROW`), `study.png` and `summary.json`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from gsparc.base.instantiate import config_node
from gsparc.commands.train import train_job
from gsparc.datasets.load import load, split_for
from gsparc.evaluation.summary import run_conditions, write_samples
from gsparc.evaluation.table import CPU, P50, P95, TRAIN, Column, Table, value_with_error
from gsparc.models.registry import build, method_class
from gsparc.pictures.plots import draw_study
from gsparc.prediction.timing import ClockSettings, machine_facts
from gsparc.runs.evaluate import dataset_facts, split_facts
from gsparc.runs.experiment.cells import compose
from gsparc.runs.experiment.runner import run_jobs
from gsparc.runs.experiment.study import Condition, average_rounds, plan_rounds
from gsparc.runs.output import begin_run, finish_run
from gsparc.runs.settings import to_dict


def configs_of(config: DictConfig) -> dict[str, DictConfig]:
    """Return what trains each of `config.variants`, overrides of `config.model`,
    then `config.baselines`.
    """
    whole = compose({}, ())
    for name in ("dataset", "split", "trainer", "callbacks", "seed", "effort", "threads"):
        OmegaConf.update(whole, name, config[name], merge=False)
    OmegaConf.update(whole, "init", None, merge=False)  # a variant names its own, if any
    # Resolved first: an interpolation would take the place of the model's own settings,
    # not join them.
    models = {
        str(name): OmegaConf.merge(config.model, overrides)
        for name, overrides in to_dict(config.variants).items()
    }
    models |= {name: OmegaConf.create(config_node(method_class(name))) for name in config.baselines}
    merged = partial(OmegaConf.merge, whole, {"model": None})
    return {name: merged({"model": model}) for name, model in models.items()}  # type: ignore[misc]


def task(config: DictConfig) -> pd.DataFrame:
    """Run the study, show its table, write its files."""
    run_dir, settings = begin_run(config)
    build(config.model)  # its parts check themselves
    conditions = instantiate(config.kind).conditions()
    data = load(settings["dataset"])
    split = split_for(settings["split"], data)
    try:
        jobs = plan_rounds(configs_of(config), conditions, int(config.rounds), data, split, run_dir)
        fits = run_jobs(jobs, train_job)
    except KeyboardInterrupt:  # whose advice is that of a comparison
        message = (
            f"the study was interrupted; hydra.run.dir={run_dir} goes on after the rounds "
            "that are done"
        )
        raise KeyboardInterrupt(message) from None
    clock = ClockSettings(rounds=int(config.queries), rounds_s=float(config.query_s))
    rows = average_rounds(fits, conditions, clock)
    facts: dict[str, Any] = {
        **dataset_facts(data),
        **split_facts(split),
        "seed": config.seed,
        "study/rounds": int(config.rounds),
    }
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
