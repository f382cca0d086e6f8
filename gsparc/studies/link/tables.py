"""The link's figures as tables for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from gsparc.studies.link.pictures import STYLES


def tables(facts: Mapping[str, Any], title: str, modulations: list[str], levels: list[float]) -> list[Table]:
    """Rates, block errors and beams; what was not computed has no table."""
    accepted = (
        f"{facts['accepted']:.0%} of {facts['positions']} positions accepted by {facts['confidence/kind']}"
    )
    rates = Table(title=f"{title}: throughput, {accepted}")
    for column in ("median SNR dB", "oracle Mbit/s", "chosen", "short", "short, accepted", "TBLER", "outage"):
        rates.add_column(column, justify="right")
    for level in levels:
        room = f"mcs/{level:.0f}dB"
        rates.add_row(
            f"{level:g}",
            f"{facts[f'{room}/oracle_mbps']:.1f}",
            f"{facts[f'{room}/chosen_mbps']:.1f}",
            _shown(facts[f"{room}/shortfall"], ".1%"),
            _shown(facts.get(f"{room}/shortfall_accepted"), ".1%"),
            f"{facts[f'{room}/tbler']:.1%}",
            f"{facts[f'{room}/outage']:.1%}",
        )
    found = [rates]
    if modulations:
        errors = Table(
            title=f"Eb/N0 (dB) at 10 % failed blocks, and dB behind perfect; truth: {facts['pusch/truth']}"
        )
        errors.add_column("receiver")
        for modulation in modulations:
            errors.add_column(modulation, justify="right")
            errors.add_column("behind", justify="right")
        for name, (label, _, _) in STYLES.items():
            cells = []
            if f"pusch/{modulations[0]}/{name}/behind_perfect_db" not in facts:
                continue
            for modulation in modulations:
                room = f"pusch/{modulation}/{name}"
                cells += [
                    _shown(facts[f"{room}/{k}"], ".2f") for k in ("ebno_at_bler_0.1", "behind_perfect_db")
                ]
            errors.add_row(label, *cells)
        found.append(errors)
    antennas = sorted(
        {int(key.split("/")[1]) for key in facts if key.startswith("beams/") and key.count("/") == 2}
    )
    if antennas:
        beams = Table(title="maximum-ratio beams, all test positions")
        for column in (
            "antennas",
            "gain dB",
            "predicted",
            "loss dB",
            "mean loss",
            "95 %",
            "worst",
            "mean, accepted",
        ):
            beams.add_column(column, justify="right")
        for count in antennas:
            keys = (
                "gain_db",
                "predicted_gain_db",
                "loss_db",
                "loss_db_mean",
                "loss_db_p95",
                "loss_db_max",
                "loss_db_accepted",
            )
            beams.add_row(str(count), *(_shown(facts[f"beams/{count}/{key}"], ".2f") for key in keys))
        found.append(beams)
    return found


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
