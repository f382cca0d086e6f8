"""Ours beside every plain method on 76 small cases: is it ever behind?

python bench/cases.py FOLDER           # its files and cells; docs/results/cases.csv: half an hour
of one core python bench/cases.py FOLDER draw.     # cases whose names begin so;
`reuse=true` and others: as of compare

Cells are those of `gsparc compare`: an interrupted run goes on. Cases of `../shared/data`, 56, are
of others; those of `draw`, twenty, are drawn by seed from what stands here. Each is cut at random
and in squares; ratios are of root mean squared errors, to the best plain method that serves a case.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import hydra
import numpy as np
import pandas as pd
import torch
from omegaconf import OmegaConf
from town import shadowed

from gsparc.commands.train import train_job
from gsparc.models.registry import plain_methods
from gsparc.physics.waves import point_wave
from gsparc.runs.experiment.cells import plan_jobs
from gsparc.runs.experiment.runner import run_jobs
from gsparc.runs.experiment.table import average_cells

MEASURED = Path(__file__).resolve().parents[2] / "shared" / "data"
ROWS = 900  # of a case, of more
COLUMNS = ["case", "split", "gsparc", "best plain", "its error", "ratio", "processor s"]
Arrays = dict[str, np.ndarray | float]
Case = tuple[str, float, Arrays]  # name, side of squares [m], measurements under the schema's names


def measured() -> Iterator[Case]:
    """Yield parts of what others measured."""

    def read(name: str) -> dict[str, np.ndarray]:
        with np.load(MEASURED / f"{name}.npz", allow_pickle=False) as stored:
            return dict(stored)

    city = read("real/powder-rss-462mhz")
    for station in (0, 2, 4, 6, 8, 10):
        moving = {
            "tx_position": on_floor(city["mobile_position"]),
            "rssi_db": city["rssi_db"][:, station],
        }
        still = np.append(city["station_position"][station], 10.0)
        yield f"city_{station}", 300.0, moving | {"rx_position": still}
    for hall, station in ((1, 0), (1, 6), (2, 3), (2, 9)):
        npz = read(f"real/ble-hall-{hall}")
        ends = {
            "tx_position": npz["mobile_position"],
            "rx_position": npz["station_position"][station],
        }
        yield f"hall_{hall}_{station}", 4.0, ends | {"rssi_db": npz["rssi_db"][:, station]}
    plane = read("real/techtile-power-reci-rf-1")
    yield (
        "plane",
        0.3,
        {name: plane[name][plane["rssi_db"] > -75] for name in ("rx_position", "rssi_db")},
    )
    for name, side in (("rss-lib1", 3.0), ("rss-tut3", 10.0), ("wifine-floor4", 5.0)):
        npz = read(f"locate/{name}")
        for most in (0, 5):  # access points, the most heard first
            level = npz["rss_dbm"][:, np.argsort(-np.isfinite(npz["rss_dbm"]).sum(0))[most]]
            yield (
                f"{name.replace('-', '_')}_{most}",
                side,
                {"rx_position": npz["position"], "rssi_db": level},
            )
    garage = read("change/garage-rounds")
    first = garage["round"] == 1
    for beacon in (2, 11):
        level, place = garage["rss_dbm"][first, beacon], on_floor(garage["position"][first])
        yield f"garage_{beacon}", 5.0, {"rx_position": place, "rssi_db": level}
    tones = read("real/techtile-csi-920mhz")
    ends = {"frequency_hz": tones["frequency_hz"]}
    for run in ("EXP005", "EXP006"):
        rows = tones["run"].astype(str) == run
        for antenna in (7, 30):
            good = rows & tones["mask"][:, antenna].astype(bool)
            ends |= {
                "rx_position": tones["rx_antenna_position"][antenna],
                "tx_position": tones["tx_position"][good],
            }
            yield f"{run.lower()}_{antenna}", 0.3, ends | {"csi": tones["csi"][good, antenna]}
    every = {name: tones[name][rows] for name in ("tx_position", "csi", "mask")}
    every |= {
        "station_position": tones["rx_antenna_position"],
        "frequency_hz": tones["frequency_hz"],
    }
    yield "exp006_all", 0.3, every
    robot = read("ofdm/wsr-los-a")
    for number in (0, 1):
        rows = robot["good"] & (robot["tx_index"] == number)
        rows &= np.isin(robot["run"], np.unique(robot["run"][rows])[:4])
        channel = (robot["root_sign"] * np.sqrt(robot["h2"]))[rows]
        ends = {
            "rx_position": robot["rx_position"][rows],
            "tx_position": robot["tx_position"][number],
        }
        turned = packets(channel, robot["subcarrier_hz"], np.random.default_rng(number))
        yield f"robot_{number}", 0.3, ends | {"csi": turned, "frequency_hz": robot["subcarrier_hz"]}


def packets(channel: np.ndarray, tones: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return channels (n, K) with a phase and a delay of up to 50 ns of each row's own."""
    phase, delay = rng.uniform(0, 2 * np.pi, len(channel)), rng.uniform(0, 50e-9, len(channel))
    return channel * np.exp(1j * (phase[:, None] - 2 * np.pi * delay[:, None] * tones))


def drawn(seed: int = 1) -> Iterator[Case]:
    """Yield worlds that nothing was chosen on: flights, floors, cells, rivers of rows, packets."""
    rng = np.random.default_rng(seed)
    for number in range(2):
        place, law = np.zeros((ROWS, 3)), np.random.default_rng([seed, number])
        place[:, :2] = np.cumsum(turns(rng, ROWS, 0.05), 0) * 0.2
        place[:, 2] = 30 + rng.normal(0, 0.1, ROWS)
        far = np.linalg.norm(place - [*rng.uniform(-60, 60, 2), 3.0], axis=1)
        slow = rng.normal(size=ROWS)
        for i in range(1, ROWS):  # noise that a third of a second remembers
            slow[i] = np.sqrt(1 - 0.7**2) * slow[i] + 0.7 * slow[i - 1]
        level = -40 - 22 * np.log10(far) + waves(law, place[:, :2], 1.0, 8.0) + 0.6 * slow
        yield f"draw.flight_{number}", 25.0, {"rx_position": place, "rssi_db": level}
        place = np.c_[rng.uniform(0, (60, 40), (400, 2)), rng.integers(0, 3, 400) * 3.5 + 1.2]
        source = np.array([*rng.uniform(5, 35, 2), 4.7])
        level = -35 - 30 * np.log10(np.linalg.norm(place - source, axis=1)) + rng.normal(0, 2, 400)
        level += waves(law, place[:, :2], 4.0, 3.0) - 15 * np.abs(
            np.round((place[:, 2] - source[2]) / 3.5)
        )
        level[level < -95] = np.nan
        yield f"draw.floors_{number}", 10.0, {"rx_position": place, "rssi_db": level}
        place, station = (
            rng.uniform(0, 1500, (400, 2)),
            np.c_[rng.uniform(0, 1500, (3, 2)), [25.0] * 3],
        )
        each = enumerate(station)
        level = np.stack(
            [shadowed(place, at, np.random.default_rng([seed, number, i])) for i, at in each], 1
        )
        level += rng.normal(0, 1.5, level.shape)
        moving = {"rx_position": on_floor(place), "station_position": station, "rssi_db": level}
        yield f"draw.cells_{number}", 200.0, moving
        place = np.cumsum(turns(rng, 3 * ROWS, 0.02), 0) * 1.5
        level = shadowed(place, np.array([*rng.uniform(-200, 200, 2), 20.0]), law)
        level += rng.normal(0, 2, 3 * ROWS)
        yield f"draw.river_{number}", 100.0, {"rx_position": on_floor(place), "rssi_db": level}
        tones = 5.5e9 + 625e3 * np.arange(-14, 15)
        place, channel = np.c_[rng.uniform(0, 0.6, (300, 2)), np.full(300, 1.0)], 0
        # The transmitter is the first
        images = np.c_[rng.uniform(-8, 8, (5, 2)), rng.uniform(0, 3, 5)]
        for amplitude, image in zip((1.0, 0.5, 0.4, 0.3, 0.3), images, strict=True):
            far = np.linalg.norm(place - image, axis=1)
            channel = (
                channel + amplitude * point_wave(torch.from_numpy(far)[:, None], tones).numpy()
            )
        channel = packets(channel, tones, rng)
        noise = rng.normal(size=(*channel.shape, 2)) @ [1, 1j] * 0.02 * np.abs(channel).mean()
        ends = {"rx_position": place, "tx_position": images[0], "frequency_hz": tones}
        yield f"draw.packets_{number}", 0.15, ends | {"csi": channel + noise}


def on_floor(place: np.ndarray) -> np.ndarray:
    """Return places (n, 2) as (n, 3), 1.5 m high."""
    return np.pad(place.astype(float), ((0, 0), (0, 1)), constant_values=1.5)


def turns(rng: np.random.Generator, count: int, by: float) -> np.ndarray:
    """Return unit steps (n, 2) of a way that turns by so many radians a step."""
    angle = np.cumsum(rng.normal(0, by, count))
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def waves(
    rng: np.random.Generator, place: np.ndarray, deviation: float, length: float
) -> np.ndarray:
    """Return a random field (n,) at places (n, 2)."""
    wave, phase = rng.normal(size=(2, 60)) / length, rng.uniform(0, 2 * np.pi, 60)
    return deviation * np.sqrt(2 / 60) * np.cos(place @ wave + phase).sum(1)


def thinned(arrays: Arrays) -> Arrays:
    """Return the rows that have a level, `ROWS` of them at most but of rivers, in their order."""
    count = len(arrays["csi"] if "csi" in arrays else arrays["rssi_db"])
    level = arrays.get("rssi_db", np.zeros(count)).reshape(count, -1)
    heard = np.flatnonzero(np.isfinite(level).any(1))
    chosen = np.sort(
        np.random.default_rng(0).permutation(heard)[: ROWS if count != 3 * ROWS else count]
    )
    return {
        name: array[chosen] if np.shape(array)[:1] == (count,) else array
        for name, array in arrays.items()
    }


def main() -> None:
    """Write files, fill cells, write the table, and say how far behind ours is."""
    folder, *words = sys.argv[1:]
    data = Path(folder) / "data"
    data.mkdir(parents=True, exist_ok=True)
    with hydra.initialize_config_module("gsparc.conf", version_base="1.3"):
        chosen = hydra.compose("compare", overrides=[word for word in words if "=" in word])
        config = OmegaConf.to_container(chosen, resolve=False)
        room = {"dataset": "newrf", "file": str(MEASURED / "newrf-conference.npz")}
        config["datasets"] = {"rfid": {"root": str(MEASURED / "rfid-s23-160")}, "conference": room}
        squares = {0.2: ["rfid"], 1.0: ["conference"]}
        for name, side, arrays in (*measured(), *drawn()):
            file = data / f"{name}.npz"
            np.savez(file, **thinned(arrays))
            config["datasets"][name] = {"dataset": "own", "file": str(file)}
            squares.setdefault(side, []).append(name)
        config["splits"] = {"random": {"choose": ["split=random", "split.redraw=true"], "draws": 1}}
        for side, names in squares.items():
            cut = {
                "choose": ["split=blocks", f"split.side_m={side}"],
                "draws": 1,
                "datasets": names,
            }
            config["splits"][f"squares_{side:g}m"] = cut
        wanted = {*plain_methods(), "gsparc"}
        config["methods"] = {
            name: method for name, method in config["methods"].items() if name in wanted
        }
        config["only"] = [f"{name}*" for name in words if "=" not in name]
        filled = run_jobs(plan_jobs(config, Path(folder) / "cells"), train_job, True, None)
    rows = average_cells(filled)
    write_table(rows, Path(__file__).resolve().parents[1] / "docs" / "results" / "cases.csv")


def write_table(rows: pd.DataFrame, file: Path) -> None:
    """Write ours beside the best plain method, a row a case,
    and print the mean and the largest ratio.
    """
    cases = []
    for (dataset, split), those in rows.groupby(["dataset", "split"], sort=False):
        # A score is of squared errors [dB] but for powers, whose root mean squared error it is.
        one = those.set_index("method")
        error = (-one.score_db).where(one.figure.str.startswith("rmse"), 10 ** (-one.score_db / 20))
        best = error.drop("gsparc").idxmin()
        ratio = error["gsparc"] / error[best]
        cases.append(
            (dataset, split, error["gsparc"], best, error[best], ratio, one.train_cpu_s["gsparc"])
        )
    table = pd.DataFrame(cases, columns=COLUMNS)
    table.to_csv(file, index=False, lineterminator="\n", float_format="%.4g")
    for at_random, those in table.groupby(table.split == "random"):
        worst = those.loc[those.ratio.idxmax()]
        text = (
            f"{len(those)} cases, ratio {those.ratio.mean():.3f}, {worst.ratio:.3f} at most "
            f"({worst.case})"
        )
        sys.stdout.write(f"{'random' if at_random else 'squares'}: {text}\n")


if __name__ == "__main__":
    main()
