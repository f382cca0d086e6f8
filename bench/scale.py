"""Seconds, memory and errors against the number of rows.

python bench/scale.py town 1000 10000 100000 1000000 >> docs/results/scale/powers.csv
python bench/scale.py city 1000 10000 100000 1000000 >> docs/results/scale/powers.csv
python bench/scale.py draw docs/results/scale docs/images

Methods may be named behind the numbers. Each is fitted in a process of its own. Seconds are of the
processor, user and system, beside those of the wall, which say little on a machine that others use:
its load stands beside them.
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
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from town import TESTED, city, town

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import fitting
from gsparc.models.method import MethodFactory
from gsparc.models.per_station import wrap_per_station
from gsparc.processes.uncertainty import standard_error
from gsparc.training.context import FitContext

POWERS = ("mean", "distance_law", "idw", "kriging", "gp", "gsparc")
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


def measured(source: str, name: str, data: Measurements, fold: Fold) -> None:
    """Write a line of one method, in the columns of docs/results/scale/powers.csv."""
    before, private, factory = peak_gb(), Private(), wrap_per_station(make(name), data)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # nothing that an earlier fit found is found again
        # Both clocks: seconds of the processor do not count what others do meanwhile.
        cpu, wall = time.process_time(), time.perf_counter()
        # All stations are one fit, as rows are what is varied here.
        context = FitContext(Path(folder), stations="together")
        method, _ = fitting.fit_or_resume(factory, data, fold, context)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    batch = data.batch(fold.test)
    ratio = method.predict(batch).mean.numpy() / batch.target.numpy()
    squared = (10 * np.log10(ratio))[:, 0] ** 2
    rmse = np.sqrt(squared.mean())
    ones = [data.batch(fold.test[i : i + 1]) for i in range(SINGLE)]
    began = time.process_time()
    for one in ones:
        method.predict(one)
    query = (time.process_time() - began) / SINGLE * 1e3
    # d sqrt(m) = dm / (2 sqrt(m)): the standard error of a root of a mean.
    spread = standard_error(squared) / (2 * rmse)
    values = (cpu, wall, query, rmse, spread, before, peak_gb(), private.most, os.getloadavg()[0])
    count = len(fold.train) + len(fold.val)
    csv.writer(sys.stdout).writerow(
        (source, name, method.label, count, *(f"{v:.4g}" for v in values))
    )
    sys.stdout.flush()


def each(source: str, methods: Sequence[str], data: Measurements, fold: Fold) -> None:
    """Write a line of every method, each fitted in a child, whose memory is then no longer held."""
    for name in methods:
        make(name)  # imports it, so that no child does
    failed = []
    for name in methods:
        # fork, not spawn: the child shares the measurements' memory, which is then counted once.
        child = os.fork()
        if child == 0:
            status = 1
            try:
                measured(source, name, data, fold)
                status = 0
            except Exception:
                traceback.print_exc()
            finally:
                # Without cleanup: handlers of the parent must not run in the child.
                os._exit(status)
        failed += [name] * bool(os.waitpid(child, 0)[1])
    if failed:
        raise SystemExit(f"{source}: {', '.join(failed)} failed, see above")


MANY = 10_000  # rows from which slopes are taken: fewer are of exact methods, or too quick to time
QUANTITIES = {
    "fit_cpu_s": "processor seconds of a fit",
    "query_cpu_ms": "processor ms of one query",
    "peak_gb": "peak memory, data included [GB]",
    "rmse": "rmse [dB], bars of two standard errors",
}


def draw(tables: Path, pictures: Path) -> None:
    """Save a picture of powers for each source that was measured;
    slopes of seconds stand in its legend.
    """
    import pandas as pd  # here: both would count in the memory that is measured

    from gsparc.pictures.drawing import panels, save, set_log_axis, style_of

    for source, table in pd.read_csv(tables / "powers.csv").groupby("source", sort=False):
        figure, places = panels(9.0, 6.4, 2, 2)
        for place, (quantity, title) in zip(places.flat, QUANTITIES.items(), strict=True):
            for name, lines in table.sort_values("rows", kind="stable").groupby(
                "method", sort=False
            ):
                # Two standard errors, about 95 %.
                errors = 2 * lines["rmse_error"] if quantity == "rmse" else None
                many, label = lines[lines["rows"] >= MANY], str(name)
                if quantity == "fit_cpu_s" and len(many) > 1:
                    slope = np.polyfit(np.log10(many["rows"]), np.log10(many[quantity]), 1)[0]
                    label += f", slope {slope:.2f}"
                place.errorbar(
                    lines["rows"],
                    lines[quantity],
                    errors,
                    label=label,
                    capsize=2,
                    **style_of(name).marked,
                )
            place.set(
                title=title, xlabel="rows", yscale="linear" if quantity == "peak_gb" else "log"
            )
            set_log_axis(place, 0)
        figure.legend(
            *places[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3
        )
        save(figure, pictures / f"scale-{source}.png")


def main(source: str, *rest: str) -> None:
    """Do what the head of this file says."""
    if source == "draw":
        draw(*map(Path, rest))
        return
    methods = [word for word in rest if not word.isdigit()] or POWERS
    for count in (int(word) for word in rest if word.isdigit()):
        data, rows = {"town": town, "city": city}[source](count), np.arange(count + TESTED)
        # Validation rows first, test rows last, which are the same whatever the count.
        each(
            source,
            methods,
            data,
            Fold(rows[count // 10 : count], rows[: count // 10], rows[count:]),
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
