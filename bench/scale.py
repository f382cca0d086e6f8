"""Seconds, memory and errors against the number of rows.

python bench/scale.py powers town 1000 10000 100000 1000000 >> docs/results/scale/powers.csv
python bench/scale.py powers city 1000 10000 100000 1000000 >> docs/results/scale/powers.csv
python bench/scale.py channels hall.h5 10000 100000 >> docs/results/scale/channels.csv
python bench/scale.py spectra FOLDER 6000 12000 25000 50000 >> docs/results/scale/spectra.csv
python bench/scale.py draw docs/results/scale docs/images

Methods may be named behind the numbers. Each is fitted in a process of its own. Seconds are of the processor,
user and system, beside those of the wall, which say little on a machine that others use: its load stands
beside them.
"""

from __future__ import annotations

import csv
import os
import resource
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from town import TESTED, city, hall, town

from gsparc.data.datasets.rfid import load_rfid
from gsparc.data.own import load_own
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import fitting
from gsparc.models.method import MethodFactory
from gsparc.models.per_station import for_stations
from gsparc.simulate.rfid_sim import write_rfid_sim
from gsparc.training.context import FitContext

POWERS = ("mean", "distance_law", "idw", "kriging", "gp", "gsparc")
CHANNELS = ("mean", "nearest", "complex_gp")
SPECTRA = ("mean", "idw", "gp", "gsparc")
# Single queries have no batch to share their overhead: 40 are enough for a mean.
SINGLE = 40  # queries asked one by one, for the time of one


def make(name: str) -> MethodFactory:
    """Return what makes the method, with what `model=` sets."""
    from hydra import compose, initialize_config_module

    from gsparc.models.registry import build

    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return build(compose("train", overrides=[f"model={name}"]).model)


class Private:
    """Watches how much memory is not of files, which the system takes back when it needs it."""

    def __init__(self) -> None:
        self.most = 0.0
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while True:
            text = Path("/proc/self/status").read_text(encoding="ascii")
            self.most = max(self.most, float(text.split("RssAnon:")[1].split()[0]) / 1e6)
            time.sleep(0.02)


def peak_gb() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def measured(source: str, name: str, data: Measurements, fold: Fold, error: Callable[..., Any]) -> None:
    """Write a line of one method, in the columns of docs/results/scale/powers.csv."""
    before, private, factory = peak_gb(), Private(), for_stations(make(name), data)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # nothing that an earlier fit found is found again
        # Both clocks: seconds of the processor do not count what others do meanwhile.
        cpu, wall = time.process_time(), time.perf_counter()
        # All stations are one fit, as rows are what is varied here.
        context = FitContext(Path(folder), stations="together")
        method, _ = fitting.fit(factory, data, fold, context)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    missed = []
    # 256 rows a batch, as targets and predictions of spectra are held beside each other.
    for part in np.array_split(fold.test, -(-len(fold.test) // 256)):
        batch = data.batch(part)
        missed.append(error(method.predict(batch).mean.numpy(), batch.target.numpy()))
    squared = np.concatenate(missed)
    rmse = np.sqrt(squared.mean())
    ones = [data.batch(fold.test[i : i + 1]) for i in range(SINGLE)]
    began = time.process_time()
    for one in ones:
        method.predict(one)
    query = (time.process_time() - began) / SINGLE * 1e3
    # d sqrt(m) = dm / (2 sqrt(m)): the standard error of a root of a mean.
    spread = squared.std() / (2 * rmse * np.sqrt(len(squared)))
    values = (cpu, wall, query, rmse, spread, before, peak_gb(), private.most, os.getloadavg()[0])
    count = len(fold.train) + len(fold.val)
    csv.writer(sys.stdout).writerow((source, name, method.label, count, *(f"{v:.4g}" for v in values)))
    sys.stdout.flush()


def each(
    source: str, methods: Sequence[str], data: Measurements, fold: Fold, error: Callable[..., Any]
) -> None:
    """Write a line of every method, each fitted in a child that shares the measurements."""
    for name in methods:
        make(name)  # imports it, so that no child does
    for name in methods:
        aside(lambda name=name: measured(source, name, data, fold, error))


def aside(work: Callable[[], Any]) -> None:
    """Do something in a child, whose memory is then no longer held."""
    # fork, not spawn: the child shares the measurements' memory, which is then counted once.
    child = os.fork()
    if child == 0:
        try:
            work()
        except Exception:
            traceback.print_exc()
        finally:
            # Without cleanup: handlers of the parent must not run in the child.
            os._exit(0)
    os.waitpid(child, 0)


def decibels(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared errors (B,) of powers [dB^2]."""
    return ((10 * np.log10(predicted / target)) ** 2)[:, 0]


def powers(source: str, counts: Sequence[int], methods: Sequence[str] = POWERS) -> None:
    """Lines of all methods for numbers of rows, a tenth of them for validation."""
    for count in counts:
        data = {"town": town, "city": city}[source](count)
        rows = np.arange(count + TESTED)
        # Validation rows first, test rows last, which are the same whatever the count.
        fold = Fold(rows[count // 10 : count], rows[: count // 10], rows[count:])
        each(source, methods, data, fold, decibels)


def relative(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared errors (B,) of channels or spectra, of the mean power of these targets."""
    axes = tuple(range(1, target.ndim))
    return (np.abs(predicted - target) ** 2).mean(axes) / (np.abs(target) ** 2).mean()


def channels(path: Path, counts: Sequence[int], methods: Sequence[str] = CHANNELS) -> None:
    """Lines of channels that are read from a file of 16 antennas by 64 tones."""
    for count in counts:
        if not path.is_file():
            hall(path, count)
        began = time.process_time()
        data, rows = load_own(path), np.arange(count + TESTED)
        read = (time.process_time() - began, peak_gb(), path.stat().st_size / 1e9)
        sys.stderr.write(
            f"{count} rows read in {read[0]:.1f} s, peak {read[1]:.2f} GB, file {read[2]:.2f} GB\n"
        )
        # Every fourth test row: one is 16 x 64 complex entries, and 500 tell the error well enough.
        fold = Fold(rows[:count], rows[:0], rows[-TESTED::4])
        each("hall", methods, data, fold, relative)
        path.unlink()


def squares(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Mean squared errors (B,) of spectra."""
    return ((predicted - target) ** 2).mean((1, 2))


def spectra(folder: Path, counts: Sequence[int], methods: Sequence[str] = SPECTRA) -> None:
    """Lines of spectra in the RFID release's layout, all of one folder, a tenth of them for validation."""
    whole = max(counts) + TESTED
    if not folder.is_dir():
        aside(lambda: write_rfid_sim(folder, whole, 0))
    private, began = Private(), time.process_time()
    data = load_rfid(folder)
    spent = time.process_time() - began
    sys.stderr.write(f"{len(data)} spectra read in {spent:.1f} s, {private.most:.2f} GB private\n")
    for count in counts:
        # Another seed for each count, test rows stay out of the draw.
        rows = np.random.default_rng(count).permutation(whole - TESTED)[:count]
        fold = Fold(np.sort(rows[count // 10 :]), np.sort(rows[: count // 10]), np.arange(whole)[-TESTED::4])
        each("spectra", methods, data, fold, squares)


def main(kind: str, *rest: str) -> None:
    """Do what the head of this file says."""
    counts = [int(word) for word in rest[1:] if word.isdigit()]
    methods = [word for word in rest[1:] if not word.isdigit()]
    if kind == "powers":
        powers(rest[0], counts, methods or POWERS)
    elif kind == "channels":
        channels(Path(rest[0]), counts, methods or CHANNELS)
    elif kind == "spectra":
        spectra(Path(rest[0]), counts, methods or SPECTRA)
    else:
        from scale_pictures import draw

        draw(Path(rest[0]), Path(rest[1]))


if __name__ == "__main__":
    main(*sys.argv[1:])
