"""Finding and building the library: nothing happens at import, and absence is explained in one line."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsparc.ops import BackendUnavailable, backends, cuda_kernels, cuda_library

UNMET = """
#include "cuda/device.h"
using namespace gsparc::device;
void kernel(int) { if (threadIdx.x != 7) warp_sync(); }
extern "C" int64_t gsparc_unmet() { return launch(kernel, 1, 1, 32, nullptr, 0); }
"""


@pytest.fixture
def nothing_loaded(monkeypatch):
    monkeypatch.setattr(cuda_kernels, "libraries", {})


def explained(monkeypatch) -> str:
    with pytest.raises(BackendUnavailable) as caught:
        backends.named("cuda")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_importing_builds_and_loads_nothing():
    code = "import gsparc.ops, sys; assert not [m for m in sys.modules if m.startswith('gsparc.ops.cuda')]"
    subprocess.run([sys.executable, "-c", code], check=True)


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


def test_no_compiler(monkeypatch, nothing_loaded, tmp_path):
    monkeypatch.setattr(cuda_library, "missing_device", lambda: None)
    monkeypatch.setattr(cuda_library, "architecture", lambda: "90")
    monkeypatch.setattr(cuda_library, "compiler", lambda: None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert "there is no nvcc to build them" in explained(monkeypatch)


def test_a_compiler_that_fails_is_quoted_and_leaves_nothing(monkeypatch, nothing_loaded, tmp_path):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text("#!/bin/sh\necho 'x.cu(3): error: no such thing' >&2\nexit 1\n")
    nvcc.chmod(0o755)
    monkeypatch.setattr(cuda_library, "missing_device", lambda: None)
    monkeypatch.setattr(cuda_library, "architecture", lambda: "90")
    monkeypatch.setattr(cuda_library, "compiler", lambda: str(nvcc))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert "no such thing" in explained(monkeypatch)
    assert not list((tmp_path / "gsparc").iterdir())


def test_the_shim_reports_a_barrier_that_not_all_threads_meet(tmp_path):
    source = tmp_path / "unmet.cpp"
    source.write_text(UNMET)
    library = tmp_path / "unmet.so"
    shim = cuda_library.SOURCES / "cuda" / "host_shim.cpp"
    flags = ["-std=c++17", "-shared", "-fPIC", f"-I{cuda_library.SOURCES}"]
    subprocess.run(["g++", *flags, str(source), str(shim), "-o", str(library)], check=True)
    code = f"import ctypes; print(ctypes.CDLL({str(library)!r}).gsparc_unmet())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["75", "90"])
def test_compiles(arch, tmp_path):
    """The whole library for an old and a new GPU, without one."""
    if cuda_library.compiler() is None:
        pytest.skip("there is no nvcc here, so the CUDA sources were only compiled for the host shim")
    path = tmp_path / "kernels.so"
    cuda_library.build(path, arch)
    listed = subprocess.run(["nm", "-D", str(path)], capture_output=True, text=True, check=True).stdout
    functions = [
        f"gsparc_{name}" for name in ("plan", "bin", "composite_backward", "weights", "thaw", "networks")
    ]
    assert all(f" T {name}" in listed for name in functions)
    if shutil.which("ldd"):
        linked = subprocess.run(["ldd", str(path)], capture_output=True, text=True, check=True).stdout
        assert "torch" not in linked and "python" not in linked


def test_sources_stay_beside_the_package():
    assert all(Path(unit).is_file() for unit in cuda_library.units())
