"""Figures of merit of the link as tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from gsparc.commands.link.pictures import STYLES
from gsparc.evaluation.summary import shown, table


def tables(facts: Mapping[str, Any], title: str, modulations: list[str], levels: list[float]) -> list[Table]:
    """Rates, block errors and beams; what was not computed has no table."""
    accepted = (
        f"{facts['accepted']:.0%} of {facts['positions']} positions accepted by {facts['confidence/kind']}"
    )
    wanted = (
        ("oracle_mbps", ".1f"), ("chosen_mbps", ".1f"), ("shortfall", ".1%"), ("shortfall_accepted", ".1%"),
        ("tbler", ".1%"), ("outage", ".1%"),
    )  # fmt: skip
    rates = [
        [f"{level:g}", *(shown(facts.get(f"mcs/{level:.0f}dB/{key}"), form) for key, form in wanted)]
        for level in levels
    ]
    columns = ["median SNR dB", "oracle Mbit/s", "chosen", "short", "short, accepted", "TBLER", "outage"]
    found = [table(f"{title}: throughput, {accepted}", [], columns, rates)]
    if modulations:
        keys = ("ebno_at_bler_0.1", "behind_perfect_db")
        errors = [
            [label, *(shown(facts[f"pusch/{m}/{name}/{key}"], ".2f") for m in modulations for key in keys)]
            for name, (label, _, _) in STYLES.items()
            if f"pusch/{modulations[0]}/{name}/behind_perfect_db" in facts
        ]
        heading = f"Eb/N0 (dB) at 10 % failed blocks, and dB behind perfect; truth: {facts['pusch/truth']}"
        numbers = [column for modulation in modulations for column in (modulation, "behind")]
        found.append(table(heading, ["receiver"], numbers, errors))
    antennas = sorted(
        {int(key.split("/")[1]) for key in facts if key.startswith("beams/") and key.count("/") == 2}
    )
    if antennas:
        named = {
            "gain_db": "gain dB", "predicted_gain_db": "predicted", "loss_db": "loss dB",
            "loss_db_mean": "mean loss", "loss_db_p95": "95 %", "loss_db_max": "worst",
            "loss_db_accepted": "mean, accepted",
        }  # fmt: skip
        beams = [[str(n), *(shown(facts[f"beams/{n}/{key}"], ".2f") for key in named)] for n in antennas]
        found.append(
            table("maximum-ratio beams, all test positions", [], ["antennas", *named.values()], beams)
        )
    return found
