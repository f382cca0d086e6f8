"""`gsparc simulate scene=... effects=... out=FILE`: a dataset, simulating only what it needs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.utils import to_absolute_path
from omegaconf import DictConfig

from gsparc.base.instantiate import from_settings
from gsparc.evaluation.console import open_console
from gsparc.pictures import simulated
from gsparc.prediction.timing import machine_facts
from gsparc.runs.output import CommandCall, Result, command
from gsparc.runs.run_lock import locked
from gsparc.runs.settings import to_dict
from gsparc.simulate.auto import AutoSettings
from gsparc.simulate.campaign import simulate
from gsparc.simulate.effects import Effects
from gsparc.simulate.effects import from_config as effects_from_config
from gsparc.simulate.report import choice_table, closing_sentences, summary_facts
from gsparc.simulate.sampling import Sampling
from gsparc.simulate.scenes.settings import from_config as scene_from_config
from gsparc.simulate.scenes.solid import write_walls
from gsparc.simulate.settings import CampaignSettings
from gsparc.simulate.spectrum import ArraySettings, SpectrumSettings

OTHERS = "ours: conference_room, shoebox; your own: osm (scene.file=TOWN.osm), xml (scene.xml=FILE)"


def campaign(config: DictConfig) -> CampaignSettings:
    """Return the campaign that a composed configuration describes.

    Raises:
        ValueError: a setting that does not exist or cannot be.
    """
    settings = to_dict(config)
    scene = scene_from_config({**settings["scene"], "moved": settings["moved"]})
    return CampaignSettings(
        scene,
        _effects(settings["effects"]),
        Sampling(**settings["sampling"]),
        from_settings(SpectrumSettings, settings["spectrum"], "spectrum"),
        from_settings(ArraySettings, settings["csi"], "csi"),
        **{name: settings[name] for name in ("shard", "check", "measurement")},
    )


def _effects(config: dict[str, Any]) -> Effects | AutoSettings:
    # Effects that are to be chosen among stand under `full`; without it they are given.
    if "full" not in config:
        return effects_from_config(config)
    return from_settings(
        AutoSettings, {**config, "full": effects_from_config(config["full"])}, "effects"
    )


@command()
def task(call: CommandCall) -> Result | None:
    """Simulate, then table, summary and a floor plan; `scene=help` lists scenes."""
    config = call.config
    if config.scene.name == "help":
        open_console().print(simulated.table_of_scenes(), OTHERS)
        return None
    out = Path(to_absolute_path(str(config.out)))
    begin, busy = time.perf_counter(), time.process_time()
    # The folder of parts is locked: a second run of the same file would add its shards to it.
    with locked(out.with_name(out.name + ".parts"), "out"):
        outcome = simulate(campaign(config), out)
    seconds = time.perf_counter() - begin
    simulated.draw_power_and_delay_spread(outcome, call.folder / "floor_plan.png")
    triangles = outcome.survey.engine.triangles()
    # The exact shoebox has walls, but no triangles.
    if len(triangles):
        write_walls(triangles, call.folder / "walls.yaml")
    facts = {
        **machine_facts(),
        **summary_facts(outcome),
        "time/total_s": seconds,
        # Of all threads: what a busy machine cannot inflate
        "time/cpu_s": time.process_time() - busy,
        "out": str(config.out),
        "out/mb": out.stat().st_size / 1e6,
    }
    tables = [] if outcome.decision is None else [choice_table(outcome.decision.choice)]
    lines = closing_sentences(outcome, seconds, facts["machine/load"])
    return Result(facts, tables, lines, f"rows in {out}; summary and pictures ")
