"""A building surveyed again, told of some places and asked about the others.

python bench/later_rows.py garage|library [fresh]   # a line a count: rmse [dB], paired errors

Shrunk constants know the variances of the other building; `fresh` fits old and new rows, too.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np

import gsparc

FOLDER = Path(__file__).parents[2] / "shared/data/change"
FILES = {"garage": ("garage-rounds.npz", "round"), "library": ("library-months.npz", "month")}
# Variances of constants of access points, and of means of places [dB^2], from the other building
NUMBERS = {"garage": (2.7, 12.1), "library": (1.4, 15.0)}
COUNTS, EACH, HEARD, DRAWS = (1, 3, 9, 30, 100), 9, 40, 3


def surveys(building: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return places (n, 3) and levels (n, T) of every survey, nine rows a place at most."""
    file, epoch = FILES[building]
    data, result = np.load(FOLDER / file), []
    places = np.c_[data["position"], np.full(len(data["position"]), 1.5)][:, :3].astype(float)
    for number in np.unique(data[epoch]):
        index = np.flatnonzero(data[epoch] == number)
        place = np.unique(places[index], axis=0, return_inverse=True)[1].reshape(-1)
        kept = np.concatenate([index[place == name][:EACH] for name in np.unique(place)])
        result.append((places[kept], data["rss_dbm"][kept].astype(float)))
    heard = np.isfinite(result[0][1]).sum(0) >= HEARD
    return [(at, levels[:, heard]) for at, levels in result]


def main() -> None:
    """Print the table of a building."""
    logging.disable(logging.WARNING)
    building, between, within = sys.argv[1], *NUMBERS[sys.argv[1]]
    (old, heard), *later = surveys(building)
    unknown = np.full((heard.shape[1], 3), np.nan)
    model = gsparc.fit(rx=old, rssi=heard, station_position=unknown)
    for count in COUNTS:
        errors = []
        for draw, (at, levels) in enumerate([*later[::3], *later[::3]][:DRAWS]):
            place = np.unique(at, axis=0, return_inverse=True)[1].reshape(-1)
            names = np.random.default_rng([draw, count]).permutation(place.max() + 1)[:count]
            told = np.isin(place, names)
            static = model.rssi(rx=at)
            missed = np.ma.masked_invalid(levels - static)
            means = np.ma.stack([missed[place == name].mean(0) for name in names])
            shrunk = means.mean(0) * between / (between + within / np.maximum(means.count(0), 1))
            model.update(rx=at[told], rssi=levels[told])
            answers = static, static + shrunk.filled(0), model.rssi(rx=at)
            model.undo()
            if "fresh" in sys.argv:
                rows = np.r_[old, at[told]], np.r_[heard, levels[told]]
                fresh = gsparc.fit(rx=rows[0], rssi=rows[1], station_position=unknown)
                answers = *answers, fresh.rssi(rx=at)
            errors.append([np.sqrt(np.nanmean((a - levels)[~told] ** 2)) for a in answers])
        less = np.array(errors) - np.array(errors)[:, :1]
        spread = less.std(0, ddof=1) / np.sqrt(DRAWS)
        parts = zip(np.mean(errors, 0), less.mean(0), spread, strict=True)
        sys.stdout.write(
            f"{count}: " + ", ".join(f"{a:.3f} ({b:+.3f} +- {c:.3f})" for a, b, c in parts)
        )
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
