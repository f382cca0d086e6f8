"""The LLVM library that Sionna's CPU back end needs: found, fetched without root, tried in a subprocess.

Dr.Jit refuses LLVM 14; with 15 and 16 it imports and then aborts the whole process at the first solve,
which no `try` catches. So a library is accepted only after a tiny solve in a process of its own.

`gsparc llvm` (or `make sionna`) fetches Debian's package where no library is good.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from rich.console import Console

VARIABLE = "DRJIT_LIBLLVM_PATH"
PACKAGE = "libllvm19"
FETCHED = Path("lib") / "llvm19" / "libLLVM.so.19.1"  # below the environment's prefix
INSTALLED = (
    "/usr/lib/llvm-19/lib/libLLVM.so.19.1",
    "/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1",
    "/usr/lib/aarch64-linux-gnu/libLLVM.so.19.1",
    "/usr/lib/llvm-20/lib/libLLVM.so.20.1",
    "/usr/lib/llvm-18/lib/libLLVM.so.18.1",
)
REMEDY = (
    f"get one with `gsparc llvm` (Debian's {PACKAGE}, no root needed) or name a library "
    f"of LLVM 19 in {VARIABLE}"
)
TINY_SOLVE = """
import sionna.rt as rt
scene = rt.load_scene(rt.scene.floor_wall)
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", position=[-2.5, 0, 3]))
scene.add(rt.Receiver("rx", position=[2.5, 0, 3]))
paths = rt.PathSolver()(scene, max_depth=1, samples_per_src=1000, diffuse_reflection=False)
assert paths.valid.numpy().sum() >= 1
"""


class SimulatorMissing(RuntimeError):
    """Sionna or its LLVM library is missing or broken; the message holds the remedy."""


def candidates() -> list[Path]:
    """Libraries to try, best first: the one the user names (then no other), ours, the system's."""
    named = os.environ.get(VARIABLE)
    if named:
        return [Path(named)]
    return [p for p in (Path(sys.prefix) / FETCHED, *map(Path, INSTALLED)) if p.exists()]


@lru_cache
def fault(library: Path) -> str | None:
    """What is wrong with a library, in words; None when a tiny solve works with it.

    The solve runs in a subprocess, because a wrong LLVM ends the process that loads it.
    """
    if not library.exists():
        return "no such file"
    tried = subprocess.run(
        [sys.executable, "-c", TINY_SOLVE],
        env={**os.environ, VARIABLE: str(library)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if tried.returncode == 0:
        return None
    lines = [line.strip() for line in tried.stderr.splitlines() if line.strip()]
    words = next((line for line in lines if "LLVM" in line), lines[-1] if lines else "no message")
    died = f"killed by signal {-tried.returncode}" if tried.returncode < 0 else f"exit {tried.returncode}"
    return f"a tiny solve failed ({died}: {words[:160]})"


def prepare() -> Path:
    """Make sure that `import sionna.rt` will work in this process, and return the library it will use.

    Raises:
        SimulatorMissing: Sionna is not installed, or no library passes the tiny solve.
    """
    _require_sionna()
    faults = []
    for library in candidates():
        wrong = fault(library)
        if wrong is None:
            os.environ[VARIABLE] = str(library)
            return library
        faults.append(f"{library}: {wrong}")
    found = "; ".join(faults) or "no LLVM library was found"
    raise SimulatorMissing(f"Sionna needs LLVM 19 (15 and 16 abort): {found}; {REMEDY}")


def fetch(prefix: Path = Path(sys.prefix)) -> Path:
    """Unpack Debian's package below `prefix` without root, and return the library.

    Raises:
        SimulatorMissing: not a Debian-like system, or its packages cannot be reached.
    """
    for tool in ("apt-get", "dpkg"):
        if shutil.which(tool) is None:
            raise SimulatorMissing(f"{tool} not found: put LLVM 19 on this machine and name it in {VARIABLE}")
    goal = prefix / FETCHED
    goal.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=goal.parent) as scratch:
        own_lists = [f"-oDir::State={scratch}/state", f"-oDir::Cache={scratch}/cache"]
        if _run(["apt-get", "-q", "download", PACKAGE], scratch) is not None:
            # The machine's package lists are stale or absent; fresh ones of our own need no root.
            for folder in ("state/lists/partial", "cache/archives/partial"):
                (Path(scratch) / folder).mkdir(parents=True)
            for command in (["update"], ["download", PACKAGE]):
                words = _run(["apt-get", "-q", *own_lists, *command], scratch)
                if words is not None:
                    raise SimulatorMissing(
                        f"apt-get {command[0]}: {words}; put LLVM 19 here and name it in {VARIABLE}"
                    )
        package = next(Path(scratch).glob("*.deb"))
        words = _run(["dpkg", "-x", package.name, "unpacked"], scratch)
        found = sorted(Path(scratch).glob("unpacked/usr/lib/**/libLLVM.so.19*"))
        if words is not None or not found:
            raise SimulatorMissing(f"{package.name} did not unpack: {words or 'no library inside'}")
        os.replace(found[0].resolve(), goal)
    return goal


def _run(command: list[str], folder: str) -> str | None:
    """The last words of a command that failed, else None."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return None if done.returncode == 0 else (lines[-1] if lines else f"exit status {done.returncode}")


def _require_sionna() -> None:
    from importlib.util import find_spec

    if find_spec("sionna") is None or find_spec("sionna.rt") is None:
        raise SimulatorMissing("Sionna is not installed; run `make sionna` or pip install 'gsparc[sionna]'")


def main(arguments: Sequence[str] | None = None) -> int:
    """`gsparc llvm`: a good library is found or fetched; exit status 0 when a tiny solve works."""
    argparse.ArgumentParser(prog="gsparc llvm", description=__doc__).parse_args(arguments)
    console = Console(soft_wrap=True, highlight=False)
    try:
        _require_sionna()
        good = next((library for library in candidates() if fault(library) is None), None)
        if good is None and not os.environ.get(VARIABLE):
            fetch()
        console.print(f"LLVM for Sionna: {prepare()}", markup=False)
    except SimulatorMissing as error:
        console.print(f"error: {error}", markup=False, style="red")
        return 1
    return 0
