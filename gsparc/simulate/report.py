"""A simulation in numbers: the table of `auto`, and flat facts for `summary.json`."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from gsparc.simulate.auto import Choice
from gsparc.simulate.campaign import Outcome

STATED = ("deliverable", "probes", "samples")


def choice_table(choice: Choice) -> Table:
    """Return a row per effect: its share of power, errors without it, its cost, kept or dropped."""
    table = Table(
        title=f"requirement: {choice.deliverable}",
        caption=describe_choice(choice),
        caption_justify="left",
    )
    table.add_column("left out")
    for name in ("power %", "p95", "error", "p95", "probes off"):
        table.add_column(name, justify="right")
    table.add_column("")
    for row in choice.table:
        table.add_row(
            row.effect.replace("_", " "),
            f"{row.share:.1%}",
            f"{row.share_p95:.1%}",
            f"{row.error:.2g}",
            f"{row.error_p95:.2g}",
            str(row.failures),
            "kept" if row.kept else "dropped",
            style="bold" if row.kept else None,
        )
    return table


def describe_choice(choice: Choice) -> str:
    """Return what was chosen, and whether the requirement is met on held-back receivers."""
    chosen = f"needed: {choice.effects}"
    chosen += "" if choice.samples is None else f", {choice.samples:,} rays"
    checked = choice.verdict
    if checked is None:
        return chosen
    outcome = "met" if checked.kept else f"NOT MET by less ({choice.refuted})"
    return (
        f"{chosen}; requirement {outcome}: {checked.met:.1%} of {checked.receivers} held-back "
        "receivers are "
        f"within tolerance (error {checked.error:.2g} median, {checked.error_p95:.2g} at 95 %)"
    )


def summary_facts(outcome: Outcome) -> dict[str, Any]:
    """Return flat facts."""
    facts: dict[str, Any] = {
        "dataset/name": outcome.data.site.name,
        "dataset/sha256": outcome.data.site.sha256,
        "dataset/receivers": len(outcome.survey.places),
        "dataset/rows": len(outcome.survey),
        "effects": str(outcome.effects),
        **{f"scene/{name}": value for name, value in outcome.facts.items()},
        **{f"time/{name}_s": value for name, value in outcome.seconds.items()},
        **{f"dataset/{name}": value for name, value in outcome.convergence.items()},
        # A resumed run that found all shards has traced nothing, in no time.
        "time/receivers_per_s": len(outcome.survey) / max(outcome.seconds["trace"], 1e-9),
    }
    if outcome.decision is not None:
        choice = outcome.decision.choice
        facts |= {f"auto/{k}": getattr(choice, k) for k in STATED}
        for row in choice.table:
            name = row.effect.replace(" > ", "_over_")
            for k in ("share", "error_p95", "failures", "kept"):
                facts[f"auto/{name}/{k}"] = getattr(row, k)
        if choice.verdict is not None:
            facts |= {f"auto/verdict/{k}": v for k, v in vars(choice.verdict).items()}
    return facts


def closing_sentences(outcome: Outcome, seconds: float, load: float) -> list[str]:
    """Return what a simulation took, and how far two seeds of it are apart, in sentences."""
    count = len(outcome.survey)
    lines = [
        f"{count} receivers with {outcome.effects} in {seconds:.0f} s (load {load:.1f} per core): "
        + ", ".join(f"{name} {value:.0f} s" for name, value in outcome.seconds.items()),
        f"{outcome.facts['below_horizon']:.1%} of the power comes from below the horizon, unseen",
    ]
    if error := outcome.convergence:
        lines.append(
            "convergence error between two seeds: channel NMSE "
            f"{error['convergence_error']:.2g}, spectra "
            f"{error['convergence_spectrum_psnr_db']:.1f} dB, SSIM "
            f"{error['convergence_spectrum_ssim']:.4f}, received power within "
            f"{error['convergence_power_db']:.2g} dB at 95 % of "
            f"{error['convergence_receivers']} receivers"
        )
    return lines
