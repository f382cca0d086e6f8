"""Finding and building the library: nothing happens at import,
and absence is explained in one line.
"""

import ctypes
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from shim import INCLUDES, SHIM

from gsparc.ops import BackendUnavailable, backends, calls, cuda_library

UNMET = """
#include "cuda/device.h"
using namespace gsparc::device;
void kernel(int) { if (threadIdx.x != 7) warp_sync(); }
extern "C" int64_t gsparc_unmet() { return launch(kernel, 1, 1, 32, nullptr, 0); }
void idle(int) {}
extern "C" int64_t gsparc_rows(int64_t rows) { return launch(idle, 1, rows, 32, nullptr, 0); }
extern "C" int64_t gsparc_steps() {
    int64_t ran = 0;
    auto step = [&](int64_t error) { return [&ran, error] { return ++ran, error; }; };
    return Steps().then(step(0)).then(step(7)).then(step(9)).result() == -7 ? ran : -1;
}
extern "C" int64_t gsparc_blocks(int64_t blocks) { return launch(idle, blocks, 1, 32, nullptr, 0); }
"""


@pytest.fixture
def nothing_loaded(monkeypatch):
    monkeypatch.setattr(calls, "libraries", {})


def explained(monkeypatch) -> str:
    with pytest.raises(BackendUnavailable) as caught:
        backends.backend_named("cuda")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_torch_without_cuda(monkeypatch, nothing_loaded):
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "was built without CUDA; install a CUDA build" in explained(monkeypatch)


@pytest.mark.parametrize(
    "said", ["Found no NVIDIA driver on your system.\nPlease check", "The NVIDIA driver is too old"]
)
def test_no_device_or_the_wrong_driver(monkeypatch, nothing_loaded, said):
    def init():
        raise RuntimeError(said)

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "init", init)
    assert said.splitlines()[0] in explained(monkeypatch)


@pytest.fixture
def device(monkeypatch, nothing_loaded, tmp_path):
    """There seems to be a GPU, and no library in the cache."""
    monkeypatch.setattr(cuda_library, "missing_device", lambda: None)
    monkeypatch.setattr(cuda_library, "architectures", lambda: ["90"])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def test_no_compiler(monkeypatch, device):
    monkeypatch.setattr(cuda_library, "compiler", lambda: None)
    assert "there is no nvcc to build them" in explained(monkeypatch)


def test_a_compiler_that_fails_is_quoted_and_leaves_nothing(monkeypatch, device, tmp_path):
    nvcc = script(tmp_path / "nvcc", "echo 'x.cu(3): error: no such thing' >&2\nexit 1\n")
    monkeypatch.setattr(cuda_library, "compiler", lambda: nvcc)
    assert "no such thing" in explained(monkeypatch)
    assert not list((tmp_path / "gsparc").iterdir())


def script(path: Path, lines: str) -> str:
    path.write_text(f"#!/bin/sh\n{lines}")
    path.chmod(0o755)
    return str(path)


def nvcc_of(folder: Path, *knows: str) -> str:
    """A compiler that knows some architectures, as `--list-gpu-arch` prints them."""
    return script(folder / "nvcc", "".join(f"echo {name}\n" for name in knows))


def test_a_gpu_newer_than_the_compiler_gets_code_that_the_driver_translates(tmp_path):
    nvcc = nvcc_of(tmp_path, "compute_75", "compute_90", "compute_90a", "compute_100")
    assert cuda_library.arch_option(nvcc, "90") == "-gencode=arch=compute_90,code=sm_90"
    assert cuda_library.arch_option(nvcc, "120") == "-gencode=arch=compute_100,code=compute_100"
    with pytest.raises(
        cuda_library.LibraryUnavailable, match=r"sm_70 and .* builds for sm_75 and newer"
    ):
        cuda_library.arch_option(nvcc, "70")
    assert (
        cuda_library.arch_option(nvcc_of(tmp_path), "61") == "-gencode=arch=compute_61,code=sm_61"
    )


def test_every_gpu_of_the_machine_is_built_for(monkeypatch):
    capabilities = [(9, 0), (7, 5), (9, 0), (12, 0)]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(capabilities))
    monkeypatch.setattr(torch.cuda, "get_device_capability", capabilities.__getitem__)
    assert cuda_library.architectures() == ["75", "90", "120"]
    assert cuda_library.library_path("75", "90").name.startswith("cuda-75-90-")


def test_a_driver_older_than_the_toolkit_is_said_when_the_library_is_loaded(monkeypatch, device):
    class Old(cuda_library.Library):
        def __init__(self, path: Path) -> None:
            pass

        def run(self, name: str, call: cuda_library.Call) -> int:
            call.built_for, call.driver = 13000, 12080
            raise RuntimeError("CUDA driver version is insufficient for CUDA runtime version")

    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(cuda_library, "Library", Old)
    kept = cuda_library.library_path("90")
    kept.parent.mkdir()
    kept.touch()
    assert ("built with CUDA 13.0 and the driver is of CUDA 12.8: update the driver") in explained(
        monkeypatch
    )
    assert not kept.exists()  # another toolkit is asked next time


def test_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "cache").touch()
    with pytest.raises(
        cuda_library.LibraryUnavailable, match="set XDG_CACHE_HOME to one that can be written"
    ):
        cuda_library.compile_to(tmp_path / "cache" / "gsparc" / "x.so", ["true"])


def test_the_shim_reports_barriers_that_not_all_threads_meet_and_grids_that_no_gpu_takes(tmp_path):
    source = tmp_path / "unmet.cpp"
    source.write_text(UNMET)
    library = tmp_path / "unmet.so"
    flags = ["-std=c++17", "-shared", "-fPIC", *INCLUDES]
    subprocess.run(["g++", *flags, str(source), str(SHIM), "-o", str(library)], check=True)
    code = f"import ctypes; print(ctypes.CDLL({str(library)!r}).gsparc_unmet())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"
    loaded = ctypes.CDLL(str(library))
    # A launch after one that failed would work on what is not there
    assert loaded.gsparc_steps() == 2
    for function in (loaded.gsparc_rows, loaded.gsparc_blocks):
        function.argtypes, function.restype = [ctypes.c_int64], ctypes.c_int64
    assert loaded.gsparc_rows(65535) == 0 and loaded.gsparc_rows(
        65536
    ) == 2 == loaded.gsparc_blocks(2**31)


def resources(told: str) -> dict[str, dict[str, int]]:
    """What ptxas -v says of each kernel of ours: bytes on the stack and spilled, registers,
    shared memory.
    """
    found, name = {}, ""
    for line in told.splitlines():
        if match := re.search(r"Compiling entry function '(\w+)'", line):
            name = match[1]
        numbers = found.setdefault(name, {})
        for what in ("stack frame", "spill stores", "registers", "smem"):
            if match := re.search(rf"(\d+) (?:bytes )?{what}", line):
                numbers[what] = int(match[1])
    return {name: numbers for name, numbers in found.items() if name.startswith("_ZN6gsparc")}


@pytest.mark.slow
@pytest.mark.parametrize("arch", [pytest.param("75", marks=pytest.mark.rare), "90"])
def test_compiles(arch, tmp_path, monkeypatch):
    """The whole library for an old and a new GPU, without one;
    every kernel fits there as it was meant to.
    """
    if cuda_library.compiler() is None:
        pytest.skip(
            "there is no nvcc here, so the CUDA sources were only compiled for the host shim"
        )
    path, run, told = tmp_path / "kernels.so", subprocess.run, []

    def kept(command, **options):
        done = run(command, **options)
        told.append((done.stdout or "") + (done.stderr or ""))
        return done

    monkeypatch.setattr(cuda_library, "FLAGS", (*cuda_library.FLAGS, "-Xptxas=-v"))
    monkeypatch.setattr(subprocess, "run", kept)
    cuda_library.build(path, arch)
    monkeypatch.undo()
    kernels = resources("\n".join(told))
    assert len(kernels) > 30
    narrow: list[str] = []
    for name, numbers in kernels.items():
        assert numbers["stack frame"] == numbers["spill stores"] == 0, f"{name} spills: {numbers}"
        assert numbers.get("smem", 0) <= 48 * 1024, (
            f"{name}: no more is there without asking: {numbers}"
        )
        assert numbers["registers"] * 128 <= 65536 // 2, (
            f"two blocks of 128 do not fit: {name} {numbers}"
        )
        if arch == "90" and re.search(r"composite_kernelIfNS0_\d+\w+ELi[14]E", name):
            narrow.append(name)
            # Eight blocks on a multiprocessor, a KiB of each the system's:
            # 132 take a whole image at once.
            assert numbers["registers"] <= 64, f"{name} {numbers}"
            assert 8 * (numbers["smem"] + 1024) <= 228 * 1024, f"{name} {numbers}"
    assert len(narrow) == (4 if arch == "90" else 0)  # two projections, two widths
    listed = subprocess.run(
        ["nm", "-D", str(path)], capture_output=True, text=True, check=True
    ).stdout
    functions = [
        f"gsparc_{name}" for name in ("plan", "bin", "composite_backward", "weights", "thaw")
    ]
    assert all(f" T {name}" in listed for name in functions)
    if shutil.which("ldd"):
        linked = subprocess.run(
            ["ldd", str(path)], capture_output=True, text=True, check=True
        ).stdout
        assert "torch" not in linked and "python" not in linked
