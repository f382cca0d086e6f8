"""Errors of maps with and without `model.prior=itm:dem.tif`, over simulated hills that shadow.

python tests/helpers/terrain_table.py [draws [real]]: real ground is that of matplotlib's sample, a
fault near Jacksboro, Tennessee, and the mast stands on the highest of twenty drawn places.

The truth is not the model of the prior: three knife edges of a path (Deygout 1966; ITU-R P.526)
over the true ground, correlated shadowing of 4 dB and noise of 1 dB. The prior knows heights every
50 m with errors of 3 m.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from matplotlib.cbook import get_sample_data
from rasterio.transform import from_origin
from scipy.interpolate import RegularGridInterpolator

import gsparc

SIDE, STEP, MHZ, POST = 8000.0, 50.0, 800.0, np.array([1200.0, 4000.0, 30.0])
COUNTS, ASKED, PHONE_M, WAVE_M = (20, 50, 200), 400, 1.5, 299.79 / MHZ
AXIS = np.arange(STEP / 2, SIDE, STEP)


def waves(rng, length, count=80):
    """Return a smooth field of deviation 1 over places (n, 2) [m]."""
    wave, phase = rng.normal(size=(count, 2)) / length, rng.uniform(0, 2 * np.pi, count)
    return lambda at: np.sqrt(2 / count) * np.cos(at[:, :2] @ wave.T + phase).sum(1)


def real_ground():
    """Return heights [m] at places (n, 2) [m] of the sample, whose squares are a second of arc."""
    heights = get_sample_data("jacksboro_fault_dem.npz")["elevation"][::-1].astype(float)
    north, east = (
        np.arange(count) * step for count, step in zip(heights.shape, (30.8, 24.8), strict=True)
    )
    grid = RegularGridInterpolator((north, east), heights)
    return lambda at: grid(at[:, ::-1])


def edge_loss(v):
    return 6.9 + 20 * np.log10(np.hypot(v - 0.1, 1) + v - 0.1) if v > -0.78 else 0.0


def obstruction(along, top, first, last):
    """Return the greatest Fresnel parameter between two points of a profile, and where it is."""
    inner = np.arange(first + 1, last)
    if not len(inner):
        return -np.inf, first
    before, after = along[inner] - along[first], along[last] - along[inner]
    line = top[first] + (top[last] - top[first]) * before / (before + after)
    v = (top[inner] - line) * np.sqrt(2 * (before + after) / (WAVE_M * before * after))
    return v.max(), inner[v.argmax()]


def true_level(ground, post, end):
    """Return the level [dB] at a place (2,) by free space and three knife edges."""
    length = np.linalg.norm(end - post[:2])
    along = np.linspace(0, length, max(int(length / 20), 3))
    profile = ground(post[:2] + along[:, None] / length * (end - post[:2]))
    bulge = along * (length - along) / (2 * 8.5e6)
    top = profile + bulge
    top[0], top[-1] = profile[0] + post[2], profile[-1] + PHONE_M
    v, main = obstruction(along, top, 0, len(along) - 1)
    sides = [obstruction(along, top, *part)[0] for part in ((0, main), (main, len(along) - 1))]
    edges = edge_loss(v) + (sum(map(edge_loss, sides)) if v > -0.78 else 0.0)
    return -20 * np.log10(4 * np.pi * length / WAVE_M) - edges


def simulate(seed, real=False):
    """Return what a DEM states, where the mast is, and levels of rows and of places asked."""
    rng = np.random.default_rng(seed)
    hills, rough, clutter = waves(rng, 700.0), waves(rng, 150.0), waves(rng, 100.0)

    def ground(at):
        return 200 + 50 * hills(at) + 4 * rough(at)

    post = POST
    if real:  # the highest of twenty places
        ground, sites = real_ground(), rng.uniform(0.2 * SIDE, 0.8 * SIDE, (20, 2))
        post = np.r_[sites[ground(sites).argmax()], POST[2]]
    at = rng.uniform(0, SIDE, (max(COUNTS) + ASKED, 2))
    level = np.array([true_level(ground, post, end) for end in at])
    level += 4 * clutter(at) + rng.normal(0, 1, len(at)) - 15  # behind walls, say
    squares = np.stack(np.meshgrid(AXIS, AXIS[::-1]), -1).reshape(-1, 2)
    dem = (ground(squares) + rng.normal(0, 3, len(squares))).reshape(len(AXIS), -1)
    return dem, post, np.c_[at, np.full(len(at), PHONE_M)], level


def errors_of(seed, folder, real=False):
    """Return rmse [dB] and share in 90 % intervals by count of rows, without and with the prior."""
    dem, post, at, level = simulate(seed, real)
    size = {"height": len(AXIS), "width": len(AXIS), "count": 1, "dtype": "float64"}
    path = Path(folder) / f"{seed}.tif"
    with rasterio.open(path, "w", transform=from_origin(0, SIDE, STEP, STEP), **size) as file:
        file.write(dem, 1)
    asked, result = slice(max(COUNTS), None), []
    for count in COUNTS:
        for prior in ({}, {"prior": {"itm": str(path), "mhz": MHZ}}):
            rows = {"rx": at[:count], "tx": post, "rssi": level[:count]}
            model = gsparc.fit(**rows, settings=prior, seed=0)
            miss = model.rssi(rx=at[asked])[:, 0] - level[asked]
            std = model.std(rx=at[asked]).reshape(len(miss))
            result.append((np.sqrt(np.mean(miss**2)), np.mean(np.abs(miss) <= 1.645 * std)))
    return np.array(result).reshape(len(COUNTS), 2, 2)


if __name__ == "__main__":
    draws, real = int([*sys.argv, 5][1]), "real" in sys.argv
    with tempfile.TemporaryDirectory() as folder:
        errors = np.array([errors_of(seed, folder, real) for seed in range(draws)])
    lines = ["| rows | without | with the terrain | less | in 90 % |", "|---|---:|---:|---:|---:|"]
    for row, count in enumerate(COUNTS):
        rmse, inside = errors[:, row, :, 0], errors[:, row, :, 1].mean(0)
        less = rmse[:, 0] - rmse[:, 1]
        gain = f"{less.mean():.2f} ± {less.std(ddof=1) / np.sqrt(draws):.2f}"
        means = " | ".join(f"{mean:.2f}" for mean in rmse.mean(0))
        lines.append(f"| {count} | {means} | {gain} | {inside[0]:.2f}, {inside[1]:.2f} |")
    sys.stdout.write("\n".join(lines) + "\n")
