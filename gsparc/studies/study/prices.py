"""`gsparc study kind=effects`: what each effect costs in training and query time, and what it buys."""

from __future__ import annotations

import csv
import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from omegaconf import DictConfig
from rich.table import Table

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split
from gsparc.evaluation.console import open_console
from gsparc.evaluation.evaluate import dataset_facts
from gsparc.evaluation.metrics import DECIDING
from gsparc.evaluation.scores import score
from gsparc.evaluation.summary import provenance, write_summary
from gsparc.methods.method import FitContext, Method
from gsparc.methods.timing import ClockSettings, cycling, interleaved, machine_facts
from gsparc.studies import cli
from gsparc.studies.study.variants import setting

log = logging.getLogger(__name__)

QUERIES = 32  # test positions asked in turn


@dataclass(frozen=True)
class Price:
    """One variant.

    Attributes:
        name: as in the configuration.
        effects: what it computes.
        value: its accuracy on the test rows.
        train_s: median over rounds of its training time [s].
        train_ratio: to the plain variant's, median over rounds of the same round's ratio.
        query_ms: median of single queries, interleaved [ms].
        query_p95_ms: [ms].
        query_ratio: to the plain variant's.
    """

    name: str
    effects: str
    value: float
    train_s: float
    train_ratio: float
    query_ms: float
    query_p95_ms: float
    query_ratio: float


def measure(
    makers: Mapping[str, Callable[[], Method]],
    data: Measurements,
    fold: Fold,
    context: FitContext,
    *,
    plain: str,
    rounds: int,
    clock: ClockSettings | None = None,
) -> list[Price]:
    """Train all in turn, `rounds` times, then ask all in turn; what the data do not allow is left out.

    Args:
        makers: unfitted methods by name.
        data, fold: trained on `fold.train` and `fold.val`, judged on `fold.test`.
        context: of every fit; each has a folder of its own.
        plain: name of the variant that others are compared with.
        rounds: trainings of each.
        clock: of the queries.

    Raises:
        ValueError: there is no variant called `plain`, or it cannot be trained.
    """
    if plain not in makers:
        raise ValueError(f"plain={plain}: no such variant; there are {', '.join(makers)}")
    fitted: dict[str, Method] = {}
    seconds: dict[str, list[float]] = {name: [] for name in makers}
    for turn in range(rounds):
        for name, make in makers.items():
            if turn and name not in fitted:
                continue
            method = make()
            try:
                report = method.fit(data, fold, replace(context, run_dir=context.run_dir / name / str(turn)))
            except ValueError as refused:
                if name == plain or "not possible" not in str(refused):
                    raise
                log.info("%s is left out: %s", name, refused)
                continue
            fitted[name] = method
            seconds[name].append(report.seconds)
            log.info("%s, round %d of %d: %.1f s", name, turn + 1, rounds, report.seconds)
    batches = [data.batch(np.array([row])) for row in fold.test[:QUERIES]]
    times = interleaved(cycling(fitted, batches), clock)
    figure = DECIDING[data.site.kind]
    found = []
    for name, method in fitted.items():
        value = score((method,), data, Split("prices", (fold,), ""), "test").figures()[figure]
        assert value is not None
        found.append(
            Price(
                name, str(method.effects or "none"), value,
                float(np.median(seconds[name])),
                float(np.median(np.array(seconds[name]) / np.array(seconds[plain]))),
                float(np.median(times[name])),
                float(np.quantile(times[name], 0.95)),
                float(np.median(times[name]) / np.median(times[plain])),
            )
        )  # fmt: skip
    return found


def task(config: DictConfig) -> list[Price]:
    """Measure, table, CSV, `summary.json`."""
    where = setting(config)
    clock = ClockSettings(rounds=int(config.queries), budget_s=float(config.query_s))
    found = measure(
        where.makers, where.data, where.fold, where.context,
        plain=str(config.plain), rounds=int(config.rounds), clock=clock,
    )  # fmt: skip
    figure = DECIDING[where.data.site.kind]
    facts: dict[str, object] = {**dataset_facts(where.data), **machine_facts(), **provenance()}
    facts |= {"seed": int(config.seed), "price/plain": str(config.plain), "price/rounds": int(config.rounds)}
    for price in found:
        own = {figure if k == "value" else k: v for k, v in asdict(price).items() if k != "name"}
        facts |= {f"price/{price.name}/{key}": value for key, value in own.items()}
    write_summary(where.run_dir / "summary.json", facts)
    with (where.run_dir / "prices.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(Price)])
        writer.writerows(asdict(price).values() for price in found)
    table = Table(title=f"{where.data.site.name}: what effects cost, and what they buy")
    for column in ("variant", "effects", figure, "train s", "ratio", "query ms", "p95", "ratio"):
        table.add_column(column, justify="left" if column in ("variant", "effects") else "right")
    for p in found:
        numbers = (p.value, p.train_s, p.train_ratio, p.query_ms, p.query_p95_ms, p.query_ratio)
        table.add_row(p.name, p.effects, *(f"{number:.3g}" for number in numbers))
    console = open_console()
    console.print(table)
    console.print(f"ratios to {config.plain!r}; written to {where.run_dir}", highlight=False)
    return found


def main() -> None:
    """Entry point."""
    cli.run(task, "prices")


if __name__ == "__main__":
    main()
