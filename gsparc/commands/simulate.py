"""`gsparc simulate scene=... effects=... out=FILE`: a dataset, simulating only what it needs."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from gsparc.commands import simulate_pictures as pictures
from gsparc.commands.output import run_directory
from gsparc.commands.run_lock import held
from gsparc.commands.settings import RunSettings, plain
from gsparc.evaluation import summary
from gsparc.evaluation.console import open_console
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.campaign import Outcome, simulate
from gsparc.simulate.effects import PropagationEffects
from gsparc.simulate.effects import from_config as effects_from_config
from gsparc.simulate.raytracer import RayTracer, Sampling
from gsparc.simulate.report import choice_table, figures, reasons
from gsparc.simulate.scenes.build import from_config as scene_from_config
from gsparc.simulate.scenes.shipped import shipped
from gsparc.simulate.scenes.solid import write_mesh
from gsparc.simulate.settings import Campaign
from gsparc.simulate.spectrum import ArraySettings, SpectrumSettings

log = logging.getLogger(__name__)

CARRIER_HZ = 3.5e9  # for looking at scenes: materials need one


def campaign(config: DictConfig) -> Campaign:
    """The campaign that a composed configuration describes.

    Raises:
        ValueError: a setting that does not exist or cannot be.
    """
    settings = plain(config)
    return Campaign(
        scene_from_config(settings["scene"]), _effects(settings["effects"]), Sampling(**settings["sampling"]),
        SpectrumSettings(**settings["spectrum"]), ArraySettings(**settings["csi"]),
        shard=int(settings["shard"]), check=int(settings["check"]), check_seed=int(settings["check_seed"]),
        weakest_db=float(settings["weakest_db"]), measurement=str(settings["measurement"]),
    )  # fmt: skip


def _effects(config: dict[str, Any]) -> PropagationEffects | AutoSettings:
    if "full" not in config:
        return effects_from_config(config)
    return AutoSettings(**{**config, "full": effects_from_config(config["full"])})


def task(config: DictConfig) -> Outcome | None:
    """Simulate, then table, summary and pictures.

    `scene=help [out=FILE.png]` lists scenes.
    """
    RunSettings.of(config)
    run_dir = run_directory()
    if config.scene.name == "help":
        _list_scenes(None if OmegaConf.is_missing(config, "out") else Path(str(config.out)))
        return None
    out = Path(to_absolute_path(str(config.out)))
    begin, busy = time.perf_counter(), time.process_time()
    with held(out.with_name(out.name + ".parts"), "out"):
        outcome = simulate(campaign(config), out)
    seconds = time.perf_counter() - begin
    pictures.floor_plan(outcome, run_dir / "floor_plan.png")
    triangles = outcome.survey.engine.triangles()
    if len(triangles):
        write_mesh(triangles, run_dir / "scene.obj")
    console = open_console()
    if outcome.choice is not None:
        pictures.effect_shares(outcome.choice, run_dir / "effects.png")
        console.print(choice_table(outcome.choice))
        for line in reasons(outcome.choice):
            console.print(line, highlight=False, soft_wrap=True, markup=False)
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    facts = {
        **figures(outcome),
        "time/total_s": seconds,
        "time/cpu_s": time.process_time() - busy,  # of all threads: what a busy machine cannot inflate
        "machine/load": load,
        "out": str(config.out),
        "out/mb": out.stat().st_size / 1e6,
        **summary.provenance(),
    }
    summary.write_summary(run_dir / "summary.json", facts)
    for line in _closing(outcome, seconds, load):
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    console.print(f"written to {out}; summary and pictures in {run_dir}", highlight=False, soft_wrap=True)
    return outcome


def _list_scenes(picture: Path | None) -> None:
    """Size, triangles and materials of every shipped scene; a plan of each in `picture` where asked."""
    table, drawn = Table(title="scene=NAME: scenes that come with Sionna"), {}
    for name in ("scene", "size [m]", "triangles", "materials"):
        table.add_column(name)
    for name in shipped():
        tracer = RayTracer(name, np.zeros(3), CARRIER_HZ)
        size = " x ".join(f"{side:.0f}" for side in np.ptp(tracer.box(), axis=0))
        drawn[f"{name}, {size} m"] = tracer.triangles()
        used = ", ".join(sorted({str(m["itu"] or n) for n, m in tracer.materials().items()}))
        table.add_row(name, size, f"{len(tracer.triangles()):,}", used)
    console = open_console()
    console.print(table)
    console.print("ours: conference_room, shoebox; your own: osm (scene.file=TOWN.osm), xml (scene.xml=FILE)")
    if picture is not None:
        pictures.plans(drawn, Path(to_absolute_path(str(picture))))
        console.print(f"plans in {picture}")


def _closing(outcome: Outcome, seconds: float, load: float) -> list[str]:
    count = len(outcome.survey)
    lines = [
        f"{count} receivers with {outcome.effects} in {seconds:.0f} s (load {load:.1f} per core): "
        + ", ".join(f"{name} {value:.0f} s" for name, value in outcome.seconds.items()),
        f"{outcome.made.facts['below_horizon']:.1%} of the power comes from below the horizon, unseen",
    ]
    if outcome.convergence is not None:
        error = outcome.convergence
        lines.append(
            f"convergence error between two seeds: channel NMSE {error.nmse:.2g}, "
            f"spectra {error.spectrum_psnr_db:.1f} dB, SSIM {error.spectrum_ssim:.4f}, "
            f"received power within {error.power_db:.2g} dB at 95 % of {error.receivers} receivers"
        )
    return lines
