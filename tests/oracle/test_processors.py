"""Other processors tried on this one: numeric tests in child processes,
one setting changed at a time.

Torch's own kernels read `ATEN_CPU_CAPABILITY`, its MKL (matrix products, factors) `MKL_CBWR`, and
numpy's and scipy's OpenBLAS `OPENBLAS_CORETYPE`; `GSPARC_TEST_KERNELS` is of `tests/conftest.py`.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SETTINGS = {
    "unset": {},
    "torch portable": {"ATEN_CPU_CAPABILITY": "default"},
    "torch AVX2": {"ATEN_CPU_CAPABILITY": "avx2"},
    "MKL compatible": {"MKL_CBWR": "COMPATIBLE"},
    "OpenBLAS Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "OpenBLAS Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "kernels portable": {"GSPARC_TEST_KERNELS": "baseline"},
    "kernels AVX2": {"GSPARC_TEST_KERNELS": "avx2"},
    "two threads": {"OMP_NUM_THREADS": "2"},
}
HARD = sorted(str(path) for path in (ROOT / "tests" / "hard_cases").glob("test_*.py"))


def assert_all_pass(setting: str, *paths: str) -> None:
    """Run fast tests in a process of their own; those who run this one have set none of it."""
    own = {name for settings in SETTINGS.values() for name in settings}
    environment = {name: value for name, value in os.environ.items() if name not in own}
    environment |= {"OMP_NUM_THREADS": "1"} | SETTINGS[setting]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-n",
        "0",
        "-m",
        "not slow",
    ]
    done = subprocess.run(
        [*command, *paths], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-1000:]


OFTEN = "OpenBLAS Haswell"  # where the suite failed once; the others are alike, each as long


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [pytest.param(one, marks=() if one == OFTEN else pytest.mark.rare) for one in SETTINGS],
)
def test_problems_and_hard_cases_pass(setting):
    assert_all_pass(setting, "tests/oracle", *HARD)
