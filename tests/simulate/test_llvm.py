import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from gsparc.simulate import llvm

needs_sionna = pytest.mark.skipif(
    importlib.util.find_spec("sionna") is None, reason="Sionna is not installed: make sionna"
)


@pytest.fixture(autouse=True)
def forget():
    llvm.library_fault.cache_clear()


def test_named_library_is_the_only_candidate(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/nowhere/libLLVM.so")
    assert llvm.find_libraries() == [Path("/nowhere/libLLVM.so")]
    monkeypatch.delenv(llvm.VARIABLE)
    assert Path("/nowhere/libLLVM.so") not in llvm.find_libraries()


def test_library_that_kills_its_process_is_reported(monkeypatch, tmp_path):
    """LLVM 15 imports and then aborts at the first solve."""
    library = tmp_path / "libLLVM-15.so"
    library.touch()
    monkeypatch.setattr(
        llvm,
        "TINY_SOLVE",
        "import os, sys; print('LLVM ERROR: fmaximum', file=sys.stderr); os.abort()",
    )
    wrong = llvm.library_fault(library)
    assert wrong is not None and "signal 6" in wrong and "fmaximum" in wrong


@needs_sionna
@pytest.mark.parametrize("fetch_missing", [False, True])
def test_no_good_library_names_file_fault_and_remedy(monkeypatch, fetch_missing):
    """One that the user names is replaced by no other."""
    monkeypatch.setenv(llvm.VARIABLE, "/nowhere/libLLVM.so")
    monkeypatch.setattr(llvm, "fetch_llvm", lambda: pytest.fail("another was fetched"))
    with pytest.raises(llvm.SimulatorMissing) as raised:
        llvm.prepare_llvm(fetch_missing)
    for words in ("/nowhere/libLLVM.so", "no such file", "python -m gsparc.simulate.llvm"):
        assert words in str(raised.value)


def test_missing_sionna_names_the_remedy(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, package=None: None)
    with pytest.raises(llvm.SimulatorMissing, match="make sionna"):
        llvm.prepare_llvm()


@pytest.mark.slow
def test_imports_leave_the_ray_tracer_alone():
    """Only `gsparc.simulate` may, and even there not before it is asked to trace."""
    code = (
        "import sys, gsparc, gsparc.commands.train, gsparc.commands.evaluate, "
        "gsparc.datasets.load\n"
        "import gsparc.simulate\n"
        "bad = [m for m in ('mitsuba', 'drjit', 'sionna.rt') if m in sys.modules]\n"
        "assert not bad, bad"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@needs_sionna
def test_working_library_is_found():
    library = llvm.prepare_llvm()
    assert library.exists() and llvm.library_fault(library) is None
