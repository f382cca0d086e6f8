"""`gsparc link ckpt=FILE`: rate adaptation, PUSCH and beams with predicted channels."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from gsparc.commands.link.adaptation import Band
from gsparc.commands.link.channels import Channels, channels, on_band
from gsparc.commands.link.pictures import STYLES, draw_acceptance, draw_errors, draw_rates
from gsparc.commands.link.pusch import RECEIVERS, Pusch, frequency_correlation
from gsparc.commands.link.study import (
    acceptance,
    adapt,
    beam_facts,
    curves,
    pusch_facts,
    rate_facts,
    tradeoff,
    transmit,
)
from gsparc.commands.output import finish, run_directory
from gsparc.commands.settings import RunSettings, plain
from gsparc.evaluation.calibration import accept
from gsparc.evaluation.open_runs import open_files
from gsparc.evaluation.summary import shown, table, write_summary
from gsparc.prediction.export import SUBCARRIERS_PER_BLOCK, centred
from gsparc.prediction.risk_threshold import Guarantee

log = logging.getLogger(__name__)

NEED_VARIANCE = ("predicted_variance", "predicted_pilots")
SHARES = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])


def band(found: Channels) -> Band:
    """One antenna's channels, for rate adaptation, which takes what states no variance for exact."""
    return Band(found.true[:, 0], found.predicted[:, 0], found.variance.nan_to_num(0.0))


def task(config: DictConfig) -> dict[str, Any]:
    """All three experiments on one checkpoint; returns the facts of `summary.json`."""
    if find_spec("sionna") is None:
        raise ValueError("gsparc link needs Sionna: make sionna, or pip install 'gsparc[sionna]'")
    RunSettings.of(config)
    torch.manual_seed(int(config.seed))
    run_dir = run_directory()
    settings = plain(config)
    run = open_files([str(config.ckpt)], settings["dataset"], settings["split"])
    method, data, fold = run.methods[0], run.data, run.split.folds[0]
    if data.site.kind != "csi" or data.site.subcarriers_hz is None:
        raise ValueError(f"gsparc link needs complex channels with their frequencies, not {data.site.kind}")
    started = time.perf_counter()
    shape, tones = settings["pusch"], data.site.subcarriers_hz
    antenna, last = int(config.antenna), data.target.shape[1]
    if not 0 <= antenna < last:
        raise ValueError(f"antenna={antenna}: the target has {last}")
    one = slice(antenna, antenna + 1)
    count, spacing = SUBCARRIERS_PER_BLOCK * shape["blocks"], 1e3 * shape["spacing_khz"]
    # What is accepted is judged on the band that is used: this antenna, the PUSCH grid.
    grid = channels(method, data, fold.test, centred(float(tones.mean()), spacing, count), one)
    evidence = on_band(grid, data, fold, fold.test)
    promise = Guarantee(**settings["promise"])
    how = config.confidence, config.spatial, int(config.seed)
    kind, threshold, test, aside = accept(evidence, promise, *how)
    rows, score = fold.test[test], evidence.scores[kind][test]
    accepted = score >= threshold.value
    bad = promise.bad(evidence.error[test])
    facts: dict[str, Any] = {
        **run.facts(), "seed": int(config.seed),
        "positions": len(rows), "confidence/kind": kind, "accepted": float(accepted.mean()),
        "promise/alpha": promise.alpha, "promise/delta": promise.delta, "promise/limit_db": promise.limit_db,
        "promise/bad_among_accepted": float(bad[accepted].mean()) if accepted.any() else None,
        "promise/calibrated_on": threshold.accepted,
        "promise/bound": threshold.bound(promise.delta),
    }  # fmt: skip
    if last > 1:
        # Nothing of a beam was chosen on any test row, so all of them count.
        every = channels(method, data, fold.test, tones)
        kept = np.isin(np.arange(len(fold.test)), test[accepted])
        facts |= beam_facts(every.true, every.predicted, kept)
    title = f"{data.site.name}, {method.name}"
    stated = bool(grid.variance.isfinite().all())
    if not stated:
        log.warning(
            "%s states no error variance: rates are adapted as if predictions were exact", method.name
        )
    facts["model/states_variance"] = stated
    shown = *Progress.get_default_columns(), TimeElapsedColumn(), TextColumn("{task.fields[now]}")
    with Progress(*shown) as bar:
        levels = settings["mcs"]["snr_db"]
        adapting = bar.add_task("rate adaptation", total=len(levels), now="")
        sure = aside[evidence.scores[kind][aside] >= threshold.value]
        own = channels(method, data, rows, tones, one)
        other = channels(method, data, fold.test[sure if len(sure) else aside], tones, one)
        rates = adapt(band(own), band(other), levels, settings["mcs"], lambda: bar.advance(adapting))
        facts |= rate_facts(rates, accepted, score) | {"time/mcs_s": time.perf_counter() - started}
        draw_rates(rates["expected"], score, title, run_dir / "mcs.png")
        write_summary(run_dir / "summary.json", facts)  # hours of PUSCH may follow
        receivers = list(shape["receivers"])
        missing = {"perfect", "lmmse", "predicted"} - set(receivers)
        if missing or set(receivers) - set(RECEIVERS):
            raise ValueError(f"pusch.receivers={receivers}: expected perfect, lmmse and predicted at least")
        wanted = {name: values for name, values in shape["ebno_db"].items() if values}
        sending = bar.add_task("PUSCH", total=sum(map(len, wanted.values())), now="")
        known = frequency_correlation(data.targets(fold.train)[:, antenna], tones, spacing, count)
        facts["pusch/truth"], grid = grid.source, grid.of(test)
        unsaid = [name for name in NEED_VARIANCE if name in receivers]
        if unsaid and not stated:
            log.warning("%s states no error variance: left out are %s", method.name, ", ".join(unsaid))
            receivers = [name for name in receivers if name not in unsaid]
        drawn, trades = {}, {}
        for modulation, points in wanted.items():
            begun = time.perf_counter()
            form = shape["blocks"], shape["spacing_khz"], known, shape["iterations"], receivers
            pusch = Pusch(modulation, *form)

            def tick(now: str, modulation: str = modulation) -> None:
                bar.update(sending, now=f"{modulation} {now}")
                bar.advance(sending)

            found = transmit(
                pusch, grid.true[:, 0], grid.predicted[:, 0], grid.variance, points,
                (shape["coarse"], shape["fine"], shape["batch"]), tick,
            )  # fmt: skip
            drawn[modulation] = curves(found, accepted)
            trades[modulation] = acceptance(found, score, SHARES)
            facts |= pusch_facts(modulation, drawn[modulation])
            write_summary(run_dir / "summary.json", facts)
            for name in ("perfect", "predicted"):
                for share, rate in zip(SHARES, trades[modulation][name], strict=True):
                    facts[f"tradeoff/{modulation}/{name}/{share:.0%}"] = float(rate)
            trade = tradeoff(found, score, SHARES)
            facts |= {f"tradeoff/{modulation}/{name}": value for name, value in trade.items()}
            facts[f"time/pusch_{modulation}_s"] = time.perf_counter() - begun
            facts["pilots/share_of_slot"] = pusch.pilot_share
            facts["pilots/saved"] = pusch.pilot_share * float(accepted.mean())
    if drawn:
        draw_errors(drawn, title, run_dir / "bler.png")
        draw_acceptance(trades, float(accepted.mean()), run_dir / "acceptance.png")
    facts["time/total_s"] = time.perf_counter() - started
    return finish(run_dir, facts, *tables(facts, title, list(wanted), levels))


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
