"""Simulated measurements of all kinds and layouts with nothing wrong:
`gsparc check` should call them good.

PYTHONPATH=tests/helpers python tests/helpers/clean_tables.py 200    # how many it warns of,
and of what
"""

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
from doors import said
from level_fields import ROWS, fields, truths

SITES, LIGHT = 3, 299792458.0
Files = tuple[str, dict[str, object]]  # what stands in the file by its name, and settings


def _powers(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Places (n, 2), levels (n, 3), rows of one transmitter (n, 3),
    and columns that say nothing.
    """
    place, level = fields(seed, SITES)
    level = np.round(level + np.random.default_rng(seed).normal(0, 2, level.shape))
    own, one, columns = truths(seed, "")
    return place, level, np.column_stack([own, one]), columns


def write(seed: int, folder: Path) -> Path:
    """Write the file of one seed; its kind and layout follow from it."""
    rng, kind = np.random.default_rng(seed), seed % 10
    place, level, alone, columns = _powers(seed)
    north, east = 48.2 + place[:, 1] / 111_200, 16.37 + place[:, 0] / 74_300
    names = [f"AP{i}" for i in range(SITES)]
    wide = pd.DataFrame(
        {"lat": north.round(7), "lon": east.round(7), **dict(zip(names, level.T, strict=True))}
    )
    long = wide.melt(["lat", "lon"], names, "bssid", "rssi").sort_index(kind="stable")
    one = pd.DataFrame(
        {"x": alone[:, 0], "y": alone[:, 1], "z": 1.5, "rssi_dbm": alone[:, 2], **columns}
    )
    path = folder / f"{seed}.csv"
    if kind == 0:  # wide, degrees
        wide.to_csv(path, index=False)
    elif kind == 1:  # long, one station after the other, decimal commas
        long.to_csv(path, index=False, sep=";", decimal=",")
    elif kind == 2:  # one transmitter beside columns that say nothing
        one.to_csv(path, index=False)
    elif kind == 3:  # a record a line
        path = path.with_suffix(".json")
        path.write_text("\n".join(map(json.dumps, long.to_dict("records"))))
    elif kind == 4:  # lists of the strongest
        best = [
            {"station": names[t], "lat": north[i], "lon": east[i], "rsrp": level[i, t]}
            for i in range(ROWS)
            for t in np.argsort(-level[i])[:2]
        ]
        pd.DataFrame(best).to_csv(path, index=False)
    elif kind == 5:  # runs, and a place in one cell
        cells = [f"POINT ({e:.7f} {n:.7f})" for e, n in zip(east, north, strict=True)]
        table = {"geometry": cells, "run": np.repeat([1, 2, 3], ROWS // 3), "rssi": level[:, 0]}
        pd.DataFrame(table).to_csv(path, index=False)
    else:
        path = path.with_suffix(".npz")
        np.savez(path, **(_spectra if kind > 8 else _channels)(place, rng, kind))
    return path


def _channels(place: np.ndarray, rng: np.random.Generator, kind: int) -> dict[str, np.ndarray]:
    """Direct path and four reflections; of one antenna and 16 tones, four and 8,
    or a single tone.
    """
    antennas, tones = ((1, 16), (4, 8), (4, 1))[kind - 6]
    rx = np.c_[place / 30, rng.uniform(0.5, 2.5, len(place))]
    tx, frequency = np.r_[rng.uniform(0, [20, 13]), 2.2], 2.4e9 + 1e6 * np.arange(tones)
    array = np.c_[np.arange(antennas) * 0.0625, np.zeros((antennas, 2))]
    csi = np.zeros((len(rx), antennas, tones), complex)
    for gain, mirror in zip(
        (1, 0.4, 0.3, 0.3, 0.2),
        [[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, 1]],
        strict=True,
    ):
        away = np.linalg.norm(rx[:, None] + array - tx * mirror, axis=2)[..., None]
        csi += gain * np.exp(-2j * np.pi * frequency * away / LIGHT) / away
    noise = (
        0.03 * np.sqrt((abs(csi) ** 2).mean() / 2) * (rng.normal(size=(*csi.shape, 2)) @ [1, 1j])
    )
    held = {"rx_position": rx, "tx_position": tx, "csi": csi + noise, "frequency_hz": frequency}
    return held | ({"array_position": array} if antennas > 1 else {})


def _spectra(place: np.ndarray, rng: np.random.Generator, kind: int) -> dict[str, np.ndarray]:
    """Lobes of a direct path and two reflections, elevations from the horizon, azimuths from x."""
    tx, rx = np.c_[place[:100] / 30, rng.uniform(1, 4, 100)], np.array([10.0, 6.0, 0.0])
    up, around = np.meshgrid(
        np.radians(np.arange(0, 90, 5)), np.radians(np.arange(0, 360, 5)), indexing="ij"
    )
    towards = np.stack(
        [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1
    )
    image = np.zeros((len(tx), *up.shape))
    for gain, mirror in ((1, [1, 1, 1]), (0.4, [-1, 1, 1]), (0.3, [1, -1, 1])):
        seen = tx * mirror - rx
        away = np.linalg.norm(seen, axis=1)
        image += (gain / away)[:, None, None] * np.exp(
            20 * (np.einsum("hwj,sj->shw", towards, seen / away[:, None]) - 1)
        )
    return {"tx_position": tx, "rx_position": rx, "spectrum": image / image.max()}


def main(count: int) -> None:
    """Print how many of so many are not good, and what is said."""
    kinds, sayings = Counter[int](), Counter[str]()
    for seed in range(count):
        with tempfile.TemporaryDirectory() as folder:
            found = said(write(seed, Path(folder))).splitlines()
        doubts = [line for line in found if line.startswith("warning")]
        doubts += [found[0]] if not found[-1].endswith(("good", "warning", "warnings")) else []
        kinds[seed % 10] += bool(doubts)
        sayings.update(f"{seed}: {doubt}" for doubt in doubts)
    sys.stdout.write("\n".join([f"{kinds.total()} of {count} {dict(kinds)}", *sayings, ""]))


if __name__ == "__main__":
    main(int(sys.argv[1]))
