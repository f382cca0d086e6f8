"""Ours beside every plain method on 76 small cases: is it ever behind?

python bench/cases.py FOLDER                   # FOLDER/cases.csv: half an hour of one core
python bench/cases.py FOLDER draw. draws=4     # cases whose names begin so, four draws of each
python bench/cases.py FOLDER reuse=true        # and any other setting of `gsparc compare`

`gsparc compare` does it: an interrupted run goes on, its own tables are beside. Cases of
`../shared/data`, 56, are of others; those of `draw`, twenty, are drawn by seed from what stands
here. Each is cut at random and in squares.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from beside_plain import PROBLEM, compare_with_plain
from town import shadowed

from gsparc.physics.waves import point_wave

MEASURED = Path(__file__).resolve().parents[2] / "shared" / "data"
ROWS = 900  # of a case, of more
COLUMNS = {
    **{"dataset": "case", "split": "split", "error": "gsparc", "method_plain": "best plain"},
    **{"error_plain": "its error", "ratio": "ratio", "train_cpu_s": "processor s"},
}
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
    """Write files, compare, and leave ours beside the best plain method, a row a case."""
    folder, words = Path(sys.argv[1]), sys.argv[2:]
    (folder / "data").mkdir(parents=True, exist_ok=True)
    room = {"dataset": "newrf", "file": str(MEASURED / "newrf-conference.npz")}
    datasets = {"rfid": {"root": str(MEASURED / "rfid-s23-160")}, "conference": room}
    splits = {"random": {"choose": ["split=random", "split.redraw=true"]}}
    sides = {"rfid": 0.2, "conference": 1.0}
    for name, side, arrays in (*measured(), *drawn()):
        file, sides[name] = folder / "data" / f"{name}.npz", side
        np.savez(file, **thinned(arrays))
        datasets[name] = {"dataset": "own", "file": str(file)}
    for side in dict.fromkeys(sides.values()):
        names = [name for name in sides if sides[name] == side]
        cut = {"choose": ["split=blocks", f"split.side_m={side}"], "datasets": names}
        splits[f"squares_{side:g}m"] = cut
    rows = compare_with_plain(folder, datasets, splits, words)
    ours = rows.method == "gsparc"
    best = rows[~ours & (rows.ratio == 1)].drop_duplicates(PROBLEM)
    table = rows[ours].merge(best, on=PROBLEM, suffixes=("", "_plain"))
    table = table.rename(columns=COLUMNS)[[*COLUMNS.values()]]
    file = folder / "cases.csv"
    table.to_csv(file, index=False, lineterminator="\n", float_format="%.4g")
    ratios = table.groupby(table.split == "random").ratio.agg(["size", "mean", "max"])
    sys.stdout.write(f"{ratios.rename({True: 'random', False: 'squares'}).to_string()}\n")


if __name__ == "__main__":
    main()
