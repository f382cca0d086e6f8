"""`gsparc link ckpt=FILE`: rate adaptation, PUSCH and beams with predicted channels."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import torch

from gsparc.apps.link.pictures import STYLES, draw_acceptance, draw_block_error_rates, draw_rates
from gsparc.apps.link.run import LinkStudy
from gsparc.evaluation.results import facts_under
from gsparc.evaluation.summary import write_summary
from gsparc.evaluation.table import Column, Table
from gsparc.runs.open_runs import open_run
from gsparc.runs.output import CommandCall, Result, command

log = logging.getLogger(__name__)

RATES = (
    Column("median SNR dB", "g", of="level"),
    Column("oracle Mbit/s", ".1f", of="oracle_mbps"),
    Column("chosen", ".1f", of="chosen_mbps"),
    Column("short", ".1%", of="shortfall"),
    Column("short, accepted", ".1%", of="shortfall_accepted"),
    Column("TBLER", ".1%", of="tbler"),
    Column("outage", ".1%", of="outage"),
)
BEAMS = (
    Column("antennas", "d", of="antennas"),
    Column("gain dB", ".2f", of="gain_db"),
    Column("predicted", ".2f", of="predicted_gain_db"),
    Column("loss dB", ".2f", of="loss_db"),
    Column("mean loss", ".2f", of="loss_db_mean"),
    Column("95 %", ".2f", of="loss_db_p95"),
    Column("worst", ".2f", of="loss_db_max"),
    Column("mean, accepted", ".2f", of="loss_db_accepted"),
)


@command()
def task(call: CommandCall) -> Result:
    """Run all three experiments on one checkpoint."""
    # Before anything is read: rates and PUSCH are Sionna's.
    if find_spec("sionna") is None:
        raise ValueError("gsparc link needs Sionna: make sionna, or pip install 'gsparc[sionna]'")
    run_dir, settings = call.folder, call.given
    # Bits, noise and channels of PUSCH are drawn from torch's global generator.
    torch.manual_seed(settings["seed"])
    run = open_run(settings["ckpt"], settings["dataset"]).read(settings["split"])
    # Seconds of the experiments alone: reading the data is not theirs.
    started = time.perf_counter()
    study = LinkStudy(run, settings)
    facts = {**run.facts(), **study.facts, **study.beams()}
    title = f"{run.data.site.name}, {study.method.name}"
    points = {name: values for name, values in settings["pusch"]["ebno_db"].items() if values}
    errors, surest = {}, {}
    rates, results = study.rates()
    facts |= results | {"time/mcs_s": time.perf_counter() - started}
    draw_rates(rates, study.confidence, study.least, title, run_dir / "mcs.png")
    write_summary(run_dir / "summary.json", facts)  # hours of PUSCH may follow
    for modulation, ebno_db in points.items():
        log.info("PUSCH, %s", modulation)
        errors[modulation], surest[modulation], results = study.send(modulation, ebno_db)
        facts |= results
        write_summary(run_dir / "summary.json", facts)
    if errors:
        draw_block_error_rates(errors, title, run_dir / "bler.png")
        draw_acceptance(surest, facts["accepted"], run_dir / "acceptance.png")
    facts["time/total_s"] = time.perf_counter() - started
    parts = tables(facts, title, list(points), settings["mcs"]["snr_db"])
    return Result(facts, parts, describe_flat_curves(facts, points))


def describe_flat_curves(facts: Mapping[str, Any], points: Mapping[str, list[float]]) -> list[str]:
    """Say of modulations that no curve of theirs crosses 10 % of failed blocks
    at the Eb/N0 sent.
    """
    return [
        f"{name}: no curve crosses 10 % failed blocks from {min(sent):g} to {max(sent):g} dB, "
        "see bler.png; "
        f"pusch.ebno_db.{name}=[...] sends at other Eb/N0"
        for name, sent in points.items()
        if not _crosses(facts, name)
    ]


def _crosses(facts: Mapping[str, Any], modulation: str) -> bool:
    keys = (f"pusch/{modulation}/{name}/ebno_at_bler_0.1" for name in STYLES)
    return any(facts.get(key) is not None for key in keys)


def tables(
    facts: Mapping[str, Any], title: str, modulations: list[str], levels: list[float]
) -> list[Table]:
    """Return tables of rates, block errors and beams; what was not computed has no table."""
    kind = facts["confidence/kind"]
    accepted = f"{facts['accepted']:.0%} of {facts['positions']} positions accepted by {kind}"
    rates = [{"level": level, **facts_under(facts, f"mcs/{level:g}dB")} for level in levels]
    sections = [Table.from_rows(f"{title}: throughput of one layer, {accepted}", RATES, rates)]
    if modulations := [name for name in modulations if _crosses(facts, name)]:
        heads = {"ebno_at_bler_0.1": "{}", "behind_perfect_db": "behind"}
        places = [(m, key) for m in modulations for key in heads]
        columns = [Column(heads[key].format(m), ".2f") for m, key in places]
        receivers = [
            [label, *(facts[f"pusch/{m}/{name}/{key}"] for m, key in places)]
            for name, (label, _, _) in STYLES.items()
            if f"pusch/{modulations[0]}/{name}/behind_perfect_db" in facts
        ]
        heading = "Eb/N0 (dB) at 10 % failed blocks of one layer, and dB behind perfect; truth: "
        heading += facts["pusch/truth"]
        sections.append(Table(heading, [Column("receiver", ""), *columns], receivers))
    # As numbers: as text 16 comes before 4.
    antennas = sorted(
        int(key.split("/")[1]) for key in facts if re.fullmatch(r"beams/\d+/gain_db", key)
    )
    if antennas:
        beams = [{"antennas": n, **facts_under(facts, f"beams/{n}")} for n in antennas]
        sections.append(Table.from_rows("maximum-ratio beams, all test positions", BEAMS, beams))
    return sections
