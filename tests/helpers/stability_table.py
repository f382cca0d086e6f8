"""The tables of docs/hard-cases.md, written from what the tests measured."""

import ast
import os
import re
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
import torch
from ledger import Ledger

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
ENGINES = ["reference", "cpu", "cuda shim", "cuda"]
KEYS = ["case", "backend", "precision"]
FORMATS = {
    "forward": "{:.1e}",
    "backward": "{:.1e}",
    "of allowed": "{:.0%}",
    "ms": "{:.2f}",
    "x truth": "{:.2f}",
}


def write(path: Path, ledger: Ledger, folder: Path) -> None:
    """Replace what lies between the markers of `path`; `folder` holds the test files.

    Cases with their remedies and kernels in full go to `results/hard-cases-*.csv` beside the page.
    """
    text, figures = path.read_text(encoding="utf-8"), _figures(ledger)
    before, rest = text.split(BEGIN)
    parts = [_conditions(ledger), _kernels(figures)]
    path.write_text(f"{before}{BEGIN}\n{''.join(parts)}{END}{rest.split(END)[1]}", encoding="utf-8")
    for name, table in (
        ("cases", _cases(ledger, folder)),
        ("kernels", _formatted(figures.reset_index())),
    ):
        table = table.assign(case=table["case"].astype(str).str.replace("_", " "))
        table.to_csv(
            path.parent / "results" / f"hard-cases-{name}.csv", index=False, lineterminator="\n"
        )


def _conditions(ledger: Ledger) -> str:
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    passed, failed = (
        sum(getattr(test, end) for test in ledger.tests.values()) for end in ("passed", "failed")
    )
    return (
        f"{passed} tests passed, {failed} failed; torch {torch.__version__.split('+')[0]}, "
        f"{os.cpu_count()} CPU cores at a load of {load:.1f} per core when it ended.\n"
    )


def _cases(ledger: Ledger, folder: Path) -> pd.DataFrame:
    rows = []
    for case, test in sorted(ledger.tests.items()):
        files = sorted(folder.rglob(f"test_{case}.py"))
        rows.append((case, _remedy(files[0]) if files else "", test.passed, f"{test.seconds:.1f}"))
    return pd.DataFrame(rows, columns=["case", "remedy", "tests", "seconds"])


def _remedy(path: Path) -> str:
    text = " ".join((ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split())
    ends = "Shown|Tolerance|Exact|Bound|Able|Found|Each|Never|Naive"
    match = re.search(rf"Remedy: (.*?)(?:\. (?:{ends})\b|$)", text)
    return match[1] if match else ""


def _figures(ledger: Ledger) -> pd.DataFrame:
    """Every case on every backend; `x truth` is the ratio to the float64 reference's time."""
    errors = pd.DataFrame(ledger.errors, columns=[*KEYS, "part", "error", "share"])
    worst = errors.groupby([*KEYS, "part"])["error"].max().unstack("part")
    times = pd.DataFrame(ledger.passes, columns=[*KEYS, "seconds"]).groupby(KEYS)["seconds"]
    median = times.median()
    truth = {case: s for (case, *kind), s in median.items() if kind == ["reference", "float64"]}
    found = worst.reindex(columns=["forward", "backward"])
    found.insert(0, "examples", times.size().reindex(found.index).astype("Int64"))
    found["of allowed"], found["ms"] = errors.groupby(KEYS)["share"].max(), 1e3 * median
    found["x truth"] = found["ms"] / (
        1e3 * found.index.get_level_values("case").map(truth).astype(float)
    )
    found = found[found.index.isin(ENGINES, level="backend")]
    order = {name: number for number, name in enumerate(ENGINES)}
    return found.sort_index(
        key=lambda level: level.map(order) if level.name == "backend" else level
    )


def _formatted(table: pd.DataFrame) -> pd.DataFrame:
    """Numbers as they are shown, nothing where there is none."""
    shown = {
        name: [form.format(value) if pd.notna(value) else "" for value in table[name]]
        for name, form in FORMATS.items()
        if name in table
    }
    return table.assign(**shown)


def _markdown(heads: Iterable[str], rule: str, rows: Iterable[Iterable[object]]) -> str:
    lines = [
        f"| {' | '.join(heads)} |",
        rule,
        *(f"| {' | '.join(map(str, row))} |" for row in rows),
    ]
    return "".join(f"{line}\n" for line in lines)


def _kernels(figures: pd.DataFrame) -> str:
    largest = {name: "max" for name in ("forward", "backward", "of allowed")}
    by = (
        figures.fillna({"forward": 0.0, "backward": 0.0})
        .groupby(KEYS[1:])
        .agg({"examples": "sum"} | largest)
    )
    by = by.reindex(
        [(e, kind) for e in ENGINES for kind in ("float32", "float64") if (e, kind) in by.index]
    )
    heads = ("backend", "precision", "examples", "forward", "backward", "of allowed")
    return (
        "\n### Accuracy of the kernels\n\n"
        "Worst of all cases: difference to the float64 reference, relative to one plus the "
        "largest value,\n"
        "and share of the tolerance. [Case by case, with "
        "times](results/hard-cases-kernels.csv).\n\n"
    ) + _markdown(
        heads, "|---|---|---:|---:|---:|---:|", _formatted(by.reset_index()).to_numpy().tolist()
    )
