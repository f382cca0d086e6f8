"""Errors from 5 to 200 rows of public stations, numbers of their own kind of site left out.

python bench/few_rows.py FILE.csv [draws]   # a line a station, count, split, draw and method

Ten minutes of one core with one draw; lines that the file has are not measured again.
"""

from __future__ import annotations

import csv
import logging
import sys
import time
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from station_numbers import Station, stations

import gsparc
from gsparc.models.powers import members
from gsparc.models.powers.known_numbers import known_numbers

COUNTS, ASKED, SQUARES, HELD = (5, 10, 20, 50, 200), 400, 8, 0.3
METHODS = "gsparc", "gp", "kriging", "idw"
HEAD = "kind", "station", "rows", "split", "draw", "method", "rmse_db", "inside_90", "fit_cpu_s"


def cut(station: Station, count: int, split: str, draw: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows that are learned from, and rows that are asked."""
    name = f"{station.kind} {station.name}"
    rng = np.random.default_rng([zlib.crc32(name.encode()), count, draw, split == "squares"])
    heard = rng.permutation(np.flatnonzero(np.isfinite(station.levels)))
    if split == "random":
        return heard[:count], heard[count : count + ASKED]
    floor = station.places[heard, :2]
    side = max(np.ptp(floor, axis=0).max() / SQUARES, 1e-6)
    corner = floor.min(0) - rng.uniform(0, side, 2)
    number = np.unique((floor - corner) // side, axis=0, return_inverse=True)[1].reshape(-1)
    names = rng.permutation(number.max() + 1)
    held = np.isin(number, names[: max(round(HELD * len(names)), 1)])
    return heard[~held][:count], heard[held][:ASKED]


def main() -> None:
    """Measure what the file lacks."""
    logging.disable(logging.WARNING)
    file, draws = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1
    lines = list(csv.reader(file.open())) if file.exists() else [HEAD]
    done = {tuple(line[:6]) for line in lines}
    with file.open("w", newline="") as output:
        writer = csv.writer(output, lineterminator="\n")
        writer.writerows(lines)
        for draw in range(draws):
            for station in stations():
                members.known_numbers = partial(known_numbers, station.kind)
                for count in COUNTS:
                    for split in ("random", "squares"):
                        known, asked = cut(station, count, split, draw)
                        if len(known) < count or len(asked) < ASKED // 40:
                            continue
                        for method in METHODS:
                            key = station.kind, station.name, str(count), split, str(draw), method
                            if key not in done:
                                writer.writerow([*key, *measure(station, known, asked, method)])
                                output.flush()
    table = pd.read_csv(file).pivot_table(
        index=["split", "rows"], columns="method", values=["rmse_db", "inside_90", "fit_cpu_s"]
    )
    sys.stdout.write(f"{table.round(3).to_string()}\n")


def measure(station: Station, known: np.ndarray, asked: np.ndarray, method: str) -> list[str]:
    """Return rms error [dB], share inside intervals of 90 %, and processor seconds of the fit."""
    given = {} if station.still is None else {"tx": station.still}
    start = time.process_time()
    model = gsparc.fit(rx=station.places[known], rssi=station.levels[known], model=method, **given)
    seconds = time.process_time() - start
    places, levels = station.places[asked], station.levels[asked]
    error = model.rssi(rx=places)[:, 0] - levels
    try:
        inside = (np.abs(error) < 1.645 * model.std(rx=places)[:, 0]).mean()
    except ValueError:  # a mean states no deviations
        inside = np.nan
    return [f"{value:.4g}" for value in (np.sqrt((error**2).mean()), inside, seconds)]


if __name__ == "__main__":
    main()
