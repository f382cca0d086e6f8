"""The LLVM library that Sionna's CPU back end needs: found, fetched without root,
tried in a subprocess.

Dr.Jit refuses LLVM 14; with 15 and 16 it imports and then aborts the whole process at the first
solve, which no `try` catches. So a library is accepted only after a tiny solve
in a process of its own.

`python -m gsparc.simulate.llvm` (or `make sionna`)
fetches Debian's package where no library is good.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import lru_cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gsparc.base.files import platform_cache, whole_file

VARIABLE = "DRJIT_LIBLLVM_PATH"
FETCHED = Path(sys.prefix) / "lib" / "llvm19" / "libLLVM.so.19.1"
SYSTEM = ("llvm-19/lib", "*-linux-gnu", "llvm-20/lib", "llvm-18/lib")  # below /usr/lib, best first
MODULE = "python -m gsparc.simulate.llvm"
REMEDY = (
    f"get one with `{MODULE}` (Debian's, no root needed) or name a library of LLVM 19 in {VARIABLE}"
)
TINY_SOLVE = """
import sionna.rt as rt
scene = rt.load_scene(rt.scene.floor_wall)
array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.tx_array = scene.rx_array = array
scene.add(rt.Transmitter("tx", position=[-2.5, 0, 3]))
scene.add(rt.Receiver("rx", position=[2.5, 0, 3]))
paths = rt.PathSolver()(scene, max_depth=1, samples_per_src=1000, diffuse_reflection=False)
assert paths.valid.numpy().sum() >= 1
"""
# Where the machine's package lists are stale or absent, fresh ones of our own need no root.
FETCH = """
own() { apt-get -q "-oDir::State=$PWD/state" "-oDir::Cache=$PWD/cache" "$@"; }
mkdir -p state/lists/partial cache/archives/partial
apt-get -q download libllvm19 || { own update && own download libllvm19; }
dpkg -x ./*.deb unpacked
mv "$(readlink -f "$(find unpacked -name 'libLLVM.so.19*' | sort | head -n 1)")" "$1"
"""


class SimulatorMissing(RuntimeError):
    """Sionna or its LLVM library is missing or broken; the message holds the remedy."""


def find_libraries() -> list[Path]:
    """Return libraries to try, best first: the one the user names (then no other), ours,
    the system's.
    """
    if named := os.environ.get(VARIABLE):
        return [Path(named)]
    system = (
        p for folder in SYSTEM for p in sorted(Path("/usr/lib").glob(f"{folder}/libLLVM.so.*.1"))
    )
    return [path for path in (FETCHED, *system) if path.exists()]


@lru_cache
def library_fault(library: Path) -> str | None:
    """Return what is wrong with a library, in words; None when a tiny solve works with it.

    The solve runs in a subprocess, because a wrong LLVM ends the process that loads it.
    """
    if not library.exists():
        return "no such file"
    seal = _seal(library)
    if seal.exists():
        return None
    environment = {**os.environ, VARIABLE: str(library)}
    solve = [sys.executable, "-c", TINY_SOLVE]
    # The first solve compiles, which takes minutes where the machine is busy.
    result = subprocess.run(solve, env=environment, capture_output=True, text=True, timeout=300)
    lines = result.stderr.strip().splitlines() or ["no message"]
    # The line that names LLVM says most; else the last one.
    words = next((line for line in lines if "LLVM" in line), lines[-1]).strip()
    if result.returncode == 0:
        with whole_file(seal) as partial:
            partial.touch()
        return None
    died = (
        f"killed by signal {-result.returncode}"
        if result.returncode < 0
        else f"exit {result.returncode}"
    )
    return f"a tiny solve failed ({died}: {words[:160]})"


def _seal(library: Path) -> Path:
    """An empty file that is there once a solve worked with this library
    and these versions of the solver.
    """
    stat = library.stat()
    # Another library, solver or interpreter is tried anew.
    parts = [str(library.resolve()), stat.st_mtime_ns, stat.st_size, sys.executable]
    for name in ("sionna-rt", "mitsuba", "drjit"):
        with suppress(PackageNotFoundError):
            parts.append(version(name))
    return platform_cache() / "llvm" / sha256(repr(parts).encode()).hexdigest()[:32]


def prepare_llvm(fetch_missing: bool = False) -> Path:
    """Make sure that `import sionna.rt` will work in this process,
    and return the library it will use.

    Raises:
        SimulatorMissing: Sionna is not installed, or no library passes the tiny solve.
    """
    if importlib.util.find_spec("sionna") is None or importlib.util.find_spec("sionna.rt") is None:
        raise SimulatorMissing(
            "Sionna is not installed; run `make sionna` or pip install 'gsparc[sionna]'"
        )
    faults = []
    for library in find_libraries():
        wrong = library_fault(library)
        if wrong is None:
            os.environ[VARIABLE] = str(library)
            return library
        faults.append(f"{library}: {wrong}")
    # A library that the user names is tried alone: another would hide that it is wrong.
    if fetch_missing and not os.environ.get(VARIABLE):
        fetch_llvm()
        return prepare_llvm()
    causes = "; ".join(faults) or "no LLVM library was found"
    raise SimulatorMissing(f"Sionna needs LLVM 19 (15 and 16 abort): {causes}; {REMEDY}")


def fetch_llvm() -> None:
    """Unpack Debian's package below the environment's prefix without root.

    Raises:
        SimulatorMissing: not a Debian-like system, or its packages cannot be reached.
    """
    FETCHED.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FETCHED.parent) as scratch:
        script = ["sh", "-ec", FETCH, "sh", str(FETCHED)]
        process = subprocess.run(script, cwd=scratch, capture_output=True, text=True)
    if process.returncode:
        words = (process.stderr.strip().splitlines() or [f"exit {process.returncode}"])[-1]
        raise SimulatorMissing(
            f"libllvm19: {words}; put LLVM 19 on this machine and name it in {VARIABLE}"
        )


if __name__ == "__main__":
    try:
        sys.stdout.write(f"LLVM for Sionna: {prepare_llvm(fetch_missing=True)}\n")
    except SimulatorMissing as error:
        sys.exit(f"error: {error}")
