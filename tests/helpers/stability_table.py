"""The tables of docs/hard-cases.md, written from what the tests measured."""

from __future__ import annotations

import ast
import csv
import os
import re
from pathlib import Path

import numpy as np
import torch
from ledger import Ledger, Tally

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
ENGINES = ("reference", "cpu", "cuda shim", "cuda")


def write(path: Path, ledger: Ledger, folder: Path) -> None:
    """Replace what lies between the markers of `path`; `folder` holds the test files.

    Cases with their remedies and kernels in full go to `results/hard-cases-*.csv` beside the page.
    """
    text = path.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    parts = [_conditions(ledger), _kernels(ledger), _counts(ledger), _seeds(ledger)]
    path.write_text(f"{before}{BEGIN}\n{''.join(parts)}{END}{after}", encoding="utf-8")
    for name, rows in (("cases", _cases(ledger, folder)), ("kernels", _figures(ledger))):
        with (path.parent / "results" / f"hard-cases-{name}.csv").open(
            "w", encoding="utf-8", newline=""
        ) as out:
            csv.writer(out, lineterminator="\n").writerows(rows)


def _conditions(ledger: Ledger) -> str:
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    passed = sum(told.passed for told in ledger.tests.values())
    failed = sum(told.failed for told in ledger.tests.values())
    return (
        f"{passed} tests passed, {failed} failed; torch {torch.__version__.split('+')[0]}, "
        f"{os.cpu_count()} CPU cores at a load of {load:.1f} per core when it ended.\n"
    )


def _cases(ledger: Ledger, folder: Path) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = [("case", "remedy", "tests", "seconds")]
    for case, told in sorted(ledger.tests.items()):
        found = sorted(folder.rglob(f"test_{case}.py"))
        remedy = _remedy(found[0]) if found else ""
        rows.append((case.replace("_", " "), remedy, told.passed, f"{told.seconds:.1f}"))
    return rows


def _remedy(path: Path) -> str:
    said = " ".join((ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split())
    found = re.search(
        r"Remedy: (.*?)(?:\. (?:Shown|Tolerance|Exact|Bound|Able|Found|Each|Never|Naive)\b|$)", said
    )
    return found[1] if found else ""


def _kernels(ledger: Ledger) -> str:
    lines = [
        "\n### Accuracy of the kernels\n\n"
        "Worst of all cases: difference to the float64 reference, relative to one plus the largest value,\n"
        "and share of the tolerance. [Case by case, with times](results/hard-cases-kernels.csv).\n\n"
        "| backend | precision | examples | forward | backward | of allowed |\n"
        "|---|---|---:|---:|---:|---:|\n"
    ]
    for engine in ENGINES:
        for kind in ("float32", "float64"):
            of = [
                tally
                for (_, name, precision), tally in ledger.tallies.items()
                if (name, precision) == (engine, kind) and tally.worst
            ]
            if of:
                worst = (f"{max(t.worst.get(part, 0.0) for t in of):.1e}" for part in ("forward", "backward"))
                share = f"{max(max(t.share.values()) for t in of):.0%}"
                cells = (engine, kind, str(sum(t.examples for t in of)), *worst, share)
                lines.append(f"| {' | '.join(cells)} |\n")
    return "".join(lines)


def _figures(ledger: Ledger) -> list[tuple[object, ...]]:
    """Every case on every backend; `x truth` is the ratio to the float64 reference's time."""
    heads = ("case", "backend", "precision", "examples", "forward", "backward", "of allowed", "ms", "x truth")
    rows: list[tuple[object, ...]] = [heads]
    truth = {case: t for (case, *kind), t in ledger.tallies.items() if kind == ["reference", "float64"]}
    order = lambda key: (key[0], ENGINES.index(key[1]) if key[1] in ENGINES else 9, key[2])  # noqa: E731
    for key in sorted(ledger.tallies, key=order):
        case, engine, kind = key
        tally = ledger.tallies[key]
        if not tally.worst or engine not in ENGINES:
            continue
        took = f"{tally.median_ms:.2f}" if tally.times else ""
        known = case in truth and tally.times
        ratio = f"{tally.median_ms / truth[case].median_ms:.2f}" if known else ""
        figures = (_figure(tally, "forward"), _figure(tally, "backward"), f"{max(tally.share.values()):.0%}")
        rows.append((case.replace("_", " "), engine, kind, tally.examples or "", *figures, took, ratio))
    return rows


def _figure(tally: Tally, part: str) -> str:
    return f"{tally.worst[part]:.1e}" if part in tally.worst else ""


def _counts(ledger: Ledger) -> str:
    lines = ["\n### Counts\n\n| what | how many | where |\n|---|---:|---|\n"]
    for what, by_case in sorted(ledger.counts.items()):
        where = ", ".join(f"{case.replace('_', ' ')} {n}" for case, n in sorted(by_case.items()))
        lines.append(f"| {what} | {sum(by_case.values())} | {where} |\n")
    return "".join(lines)


def _seeds(ledger: Ledger) -> str:
    if not ledger.seeds:
        return ""
    lines = [
        "\n### Seeds\n\nError of runs of 15 steps, relative to the power of the target: no figure of merit, "
        "the runs are there to break.\n\n"
        "| dataset | seeds | median [dB] | least to largest [dB] | s per run |\n|---|---:|---:|---:|---:|\n"
    ]
    for name, runs in sorted(ledger.seeds.items()):
        figures, seconds = np.array(runs).T
        lines.append(
            f"| {name} | {len(runs)} | {np.median(figures):.2f} | {figures.min():.2f} to {figures.max():.2f} "
            f"| {np.median(seconds):.1f} |\n"
        )
    return "".join(lines)
