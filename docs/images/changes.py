"""The picture of docs/changes.md: a room whose screen is noticed and learned,
and a town's map from before.

python docs/images/changes.py
"""

import logging
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import gsparc

OUT = Path(__file__).parent / "changes.png"
POST, SIDE, TOWN = [9.0, 9.0, 2.6], 20.0, 600.0


def field(places, seed, length):
    """Levels (n,) of a smooth random field with deviation 4 dB."""
    rng = np.random.default_rng(seed)
    waves, phase = rng.normal(size=(60, 2)) * 1.4 / length, rng.uniform(0, 2 * np.pi, 60)
    return 4 * np.sqrt(2 / 60) * np.cos(places[:, :2] @ waves.T + phase).sum(1)


def draw(count, seed, side):
    """Places (count, 3) on a floor."""
    return np.c_[np.random.default_rng(seed).uniform(0, side, (count, 2)), np.full(count, 1.5)]


def screened(places, stands=True):
    """Levels (n,) of a room; if it `stands`, a screen of 12 dB is before a disc of 4 m."""
    disc = np.linalg.norm(places[:, :2] - 5, axis=1) < 4
    return -60 + field(places, 1, 4.0) - 12 * (stands & disc)


def planned(places, number=1):
    """What a planning tool knows of a town [dBm]."""
    return -40 - 30 * np.log10(np.hypot(*places[:, :2].T) + 10) + 2 * field(places, number, 60.0)


def grid(low, high, count=61):
    """Places (count^2, 3) on a square floor."""
    axis = np.linspace(low, high, count)
    return np.c_[np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2), np.full(count**2, 1.5)]


def room():
    """Titles, maps (n,) and rows of the first line of panels."""
    noise = np.random.default_rng(2)
    before, near, asked = draw(300, 0, SIDE), draw(4000, 6, SIDE), grid(0, SIDE)
    near = near[np.linalg.norm(near[:, :2] - 5, axis=1) < 6][:50]
    model = gsparc.fit(
        rx=before, rssi=screened(before, False) + noise.normal(size=300), tx=POST, model="gp"
    )
    yield "true later: a screen in a disc", screened(asked), None, None
    yield "the map before", model.rssi(rx=asked)[:, 0], None, None
    told = screened(near, True) + noise.normal(size=50)
    for count in (10, 50):
        found = model.update(rx=near[:count], rssi=told[:count])
        alarm = found.alarms[0] if found.alarms else None
        said = "" if alarm is None else f"; alarm: {alarm.kind}, {alarm.change_db:.0f} dB"
        place = None if alarm is None else alarm.place
        yield f"after {count} rows{said}", model.rssi(rx=asked)[:, 0], near[:count], place
        model.undo()


def town():
    """The same of the second line."""
    asked, squares, rows = (
        grid(50, 650),
        grid(5, 695, 70),
        draw(20, 103, TOWN) + np.array([50, 50, 0]),
    )
    truth = lambda places: planned(places) + 0.75 * field(places, 21, 30.0)  # noqa: E731
    known = {
        "rx": rows,
        "tx": [0.0, 0, 20],
        "rssi": truth(rows) + np.random.default_rng(1).normal(0, 1, 20),
    }
    yield "true", truth(asked), None, None
    yield "learned from 20 rows", gsparc.fit(**known).rssi(rx=asked)[:, 0], rows, None
    for name, which in (("and a planned map", 1), ("and another town's map: left out", 51)):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "map.npz"
            np.savez(
                file, rx_position=squares, tx_position=known["tx"], rssi_db=planned(squares, which)
            )
            found = gsparc.fit(**known, settings={"prior": file})
        yield name, found.rssi(rx=asked)[:, 0], rows, None


def main():
    """Write `changes.png`."""
    logging.disable(logging.WARNING)
    figure, axes = plt.subplots(2, 4, figsize=(12, 6.2), layout="constrained")
    for line, panels, low, side in (
        (axes[0], [*room()], 0.0, SIDE),
        (axes[1], [*town()], 50.0, TOWN),
    ):
        truth = panels[0][1]
        for axis, (title, level, rows, alarm) in zip(line, panels, strict=True):
            image = axis.imshow(
                level.reshape(61, 61),
                origin="lower",
                extent=(low, low + side) * 2,
                vmin=truth.min(),
                vmax=truth.max(),
            )
            error = np.sqrt(np.mean((level - truth) ** 2))
            axis.set_title(title if level is truth else f"{title}\nrmse {error:.1f} dB", fontsize=9)
            if rows is not None:
                axis.plot(*rows[:, :2].T, "k.", markersize=3, label="rows told of")
            if alarm is not None:
                axis.plot(*alarm, "r*", markersize=11, label="alarm")
            axis.tick_params(labelsize=7)
        line[2].legend(fontsize=7, loc="upper right")
        figure.colorbar(image, ax=line, label="level [dBm]", shrink=0.8)
    axes[0, 0].set_ylabel("a room [m]")
    axes[1, 0].set_ylabel("a town [m]")
    figure.savefig(OUT, dpi=90)


if __name__ == "__main__":
    main()
