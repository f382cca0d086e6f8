"""The CUDA kernels as a shared library: found in the cache or built on first use.

The library is plain C (no Python, no libtorch): addresses of tensors go in, and torch's own stream.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import re
import shutil
import subprocess
import time
from pathlib import Path

import torch

from gsparc.ops.calls import Call

SOURCES = Path(__file__).parent / "csrc"
FLAGS = ("-std=c++17", "-O3", "-fmad=false", "--expt-relaxed-constexpr", "-Xcompiler=-fPIC", "-shared", "-t0")
LOG = logging.getLogger(__name__)


class LibraryUnavailable(RuntimeError):
    """The CUDA kernels are not available; the message says why in one line."""


class Library:
    """A loaded library of kernels.

    Args:
        path: shared library with the functions `gsparc_*` of csrc/cuda.
    """

    def __init__(self, path: Path) -> None:
        self._loaded = ctypes.CDLL(str(path))
        self._loaded.gsparc_error.restype = ctypes.c_char_p
        self._loaded.gsparc_error.argtypes = [ctypes.c_int64]
        self._functions: dict[str, ctypes._NamedFuncPointer] = {}

    def run(self, name: str, call: Call) -> int:
        """Call `gsparc_<name>`: its result, if that is not an error (RuntimeError)."""
        function = self._functions.get(name)
        if function is None:
            function = self._functions[name] = getattr(self._loaded, f"gsparc_{name}")
            function.restype, function.argtypes = ctypes.c_int64, [ctypes.POINTER(Call)]
        result = function(ctypes.byref(call))
        # Negative results are CUDA's errors, others a kernel's own.
        if result < 0:
            raise RuntimeError(f"CUDA kernel {name}: {self._loaded.gsparc_error(-result).decode()}")
        return result

    def check(self) -> None:
        """Ask the driver whether it can run these kernels on the current GPU (LibraryUnavailable)."""
        call = Call(device=torch.cuda.current_device())
        try:
            self.run("check", call)
        except RuntimeError as error:
            built, driver = (
                f"{version // 1000}.{version % 1000 // 10}" for version in (call.built_for, call.driver)
            )
            raise LibraryUnavailable(
                f"{error}; the kernels were built with CUDA {built} and the driver is of CUDA {driver}: "
                "update the driver, or set CUDA_HOME to a toolkit no newer than it"
            ) from error


def load() -> Library:
    """Return the library for this machine's GPUs, built if need be (LibraryUnavailable)."""
    reason = missing_device()
    if reason:
        raise LibraryUnavailable(reason)
    wanted = architectures()
    path = library_path(*wanted)
    if not path.exists():
        build(path, *wanted)
    library = Library(path)
    try:
        library.check()
    except LibraryUnavailable:
        path.unlink(missing_ok=True)  # so that another toolkit is asked next time
        raise
    return library


def missing_device() -> str | None:
    """Say why this process cannot use a GPU, or None."""
    if torch.version.cuda is None:
        return f"this PyTorch ({torch.__version__}) was built without CUDA; install a CUDA build of torch"
    if torch.cuda.is_available():
        return None
    try:
        torch.cuda.init()
    except RuntimeError as error:  # no driver, too old a driver, no device: torch says which
        return f"PyTorch finds no usable NVIDIA GPU: {str(error).splitlines()[0]}"
    return "PyTorch finds no usable NVIDIA GPU"


def architectures() -> list[str]:
    """Compute capabilities of all GPUs here, as in `sm_90` without the prefix."""
    devices = range(torch.cuda.device_count())
    return sorted({"{}{}".format(*torch.cuda.get_device_capability(device)) for device in devices}, key=int)


def compiler() -> str | None:
    """Return the path of nvcc, or None."""
    homes = [os.environ.get(name) for name in ("CUDA_HOME", "CUDA_PATH")]
    for home in [*homes, "/usr/local/cuda"]:
        if home and (Path(home) / "bin" / "nvcc").exists():
            return str(Path(home) / "bin" / "nvcc")
    return shutil.which("nvcc")


def library_path(*architectures: str) -> Path:
    """Return where the library of these sources for these GPUs is kept between runs."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "gsparc" / f"cuda-{'-'.join(architectures)}-{hash_sources(*FLAGS)}.so"


def hash_sources(*also: str) -> str:
    """Return the hash of the sources and of `also`, such as compiler flags."""
    digest = hashlib.sha256(repr(also).encode())
    for source in sorted([*SOURCES.glob("*.h"), *SOURCES.glob("projection/*"), *SOURCES.glob("cuda/*")]):
        digest.update(source.name.encode() + source.read_bytes())
    return digest.hexdigest()[:16]


def cuda_sources() -> list[str]:
    """Return the sources to compile."""
    return sorted(str(unit) for unit in (SOURCES / "cuda").glob("*.cu"))


def build(path: Path, *architectures: str) -> None:
    """Compile the library for compute capabilities such as "90" (LibraryUnavailable)."""
    nvcc = compiler()
    if nvcc is None:
        raise LibraryUnavailable(
            "the CUDA kernels are not built and there is no nvcc to build them; install the CUDA toolkit or "
            "set CUDA_HOME"
        )
    targets = [arch_option(nvcc, arch) for arch in architectures]
    LOG.info("building the CUDA kernels for sm_%s (about a minute, once)", ", sm_".join(architectures))
    started = time.perf_counter()
    compile_to(path, [nvcc, *FLAGS, *targets, f"-I{SOURCES}", *cuda_sources()])
    LOG.info("built in %.0f s: %s", time.perf_counter() - started, path)


def arch_option(nvcc: str, arch: str) -> str:
    """Return nvcc's option for a GPU: native code, or PTX for one newer than nvcc."""
    listed = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True, check=False).stdout
    archs = sorted({int(number) for number in re.findall(r"compute_(\d+)\b", listed)})
    if not archs or int(arch) in archs:
        return f"-gencode=arch=compute_{arch},code=sm_{arch}"
    older = [number for number in archs if number < int(arch)]
    if not older:
        raise LibraryUnavailable(
            f"this GPU is sm_{arch} and {nvcc} builds for sm_{archs[0]} and newer; "
            "set CUDA_HOME to an older CUDA toolkit"
        )
    # PTX of the newest GPU that nvcc knows: the driver compiles it for this one.
    return f"-gencode=arch=compute_{older[-1]},code=compute_{older[-1]}"


def compile_to(path: Path, command: list[str]) -> None:
    """Run a compiler; its output replaces `path` atomically (LibraryUnavailable)."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LibraryUnavailable(
            f"no folder for the kernels: {error}; set XDG_CACHE_HOME to one that can be written"
        ) from error
    # Processes may build at the same time: each writes its own file, and any of them is good.
    unfinished = path.with_suffix(f".{os.getpid()}")
    process = subprocess.run([*command, "-o", str(unfinished)], capture_output=True, text=True, check=False)
    if process.returncode:
        unfinished.unlink(missing_ok=True)
        lines = (process.stderr or process.stdout).strip().splitlines()
        # Compilers print much around the one line that names the error.
        first = next(
            (line for line in lines if "error" in line or "fatal" in line), lines[0] if lines else ""
        )
        raise LibraryUnavailable(f"the CUDA kernels do not compile with {command[0]}: {first}")
    unfinished.replace(path)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        load()
    except LibraryUnavailable as unavailable:
        raise SystemExit(str(unavailable)) from None
