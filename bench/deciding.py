"""Whole time of `gsparc simulate` with effects=auto against effects=all: deciding and compiling included.

python bench/deciding.py WORK 200 400 1000 5000 -- scene=simple_street_canyon scene.seed=1 >> times.csv

By turns, each in a process of its own: everything on, then `auto`, both with empty caches (of kernels and of
decisions); then both again with what their first runs left there. Seconds are of the processor, user and
system, and of the wall, start of the program included. What WORK/times.csv has is not run again, so that a
long table is made in pieces: --seconds says after how many nothing more is begun.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

HEAD = ("scene", "receivers", "run", "effects", "cpu_s", "wall_s", "load")
KEPT = "llvm"  # which library works is no matter of a scene


def main() -> None:
    """Rows of the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("receivers", type=int, nargs="+")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    split = sys.argv.index("--")
    asked, settings = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    name = next(one.split("=")[1] for one in settings if one.startswith("scene="))
    table, begin = asked.work / "times.csv", time.perf_counter()
    asked.work.mkdir(parents=True, exist_ok=True)
    done = {tuple(row[:4]) for row in csv.reader(table.open())} if table.exists() else set()
    for receivers in asked.receivers:
        for run in ("first", "second"):
            for effects in ("all", "auto"):
                key = (name, str(receivers), run, effects)
                if key in done:
                    continue
                if time.perf_counter() - begin > asked.seconds:
                    return
                row = (
                    *key,
                    *timed(asked.work / "-".join((name, str(receivers), effects)), *key[1:], settings),
                )
                with table.open("a") as file:
                    csv.writer(file).writerow(row)
                sys.stdout.write(",".join(row) + "\n")
                sys.stdout.flush()


def timed(folder: Path, receivers: str, run: str, effects: str, settings: list[str]) -> tuple[str, ...]:
    """Seconds of the processor and of the wall, and the load at the end, of one run.

    Raises:
        SystemExit: it failed.
    """
    if run == "first":
        shutil.rmtree(folder, ignore_errors=True)
        own = Path.home() / ".cache" / "gsparc" / KEPT
        if own.is_dir():
            shutil.copytree(own, folder / "cache" / "gsparc" / KEPT)
    out, log = folder / f"{run}.h5", folder / f"{run}.log"
    shutil.rmtree(f"{out}.parts", ignore_errors=True)
    out.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "gsparc",
        "simulate",
        f"effects={effects}",
        f"scene.num_receivers={receivers}",
    ]
    command += [*settings, f"out={out}", f"hydra.run.dir={folder / run}"]
    # Dr.Jit keeps kernels below HOME; fonts of pictures are no matter of a scene either.
    caches = {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}
    caches["MPLCONFIGDIR"] = os.environ.get("MPLCONFIGDIR", str(Path.home() / ".cache" / "matplotlib"))
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with log.open("w") as file:
        ended = subprocess.run(command, env={**os.environ, **caches}, stdout=file, stderr=file).returncode
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if ended:
        raise SystemExit(f"{log}: exit {ended}")
    out.unlink()
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{busy:.1f}", f"{wall:.1f}", f"{os.getloadavg()[0] / (os.cpu_count() or 1):.1f}"


if __name__ == "__main__":
    main()
