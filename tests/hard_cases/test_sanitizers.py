"""The C++ kernels under AddressSanitizer and UndefinedBehaviorSanitizer,
over hard cases and random fields.

Remedy: none needed where nothing is found. The module is built apart (CMake option
GSPARC_SANITIZE), and the tests of the kernels run on it unchanged: memory beside a tensor or a
plan, overflowing integers, casts of numbers that the integer cannot hold end the run. Able to fail:
a plan whose order leaves the tensors does.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

ROOT = Path(__file__).parents[2]
SOURCES = sorted([*(ROOT / "ops" / "csrc").glob("*.*"), ROOT / "CMakeLists.txt"])
CASES = [
    *(
        "seam",
        "pole",
        "horizon",
        "at_the_receiver",
        "needle_pancake",
        "zero_quaternion",
        "near_opaque",
    ),
    *("underflow", "ties", "nobody_there", "everybody_there", "threads", "fields_and_poses"),
]
OVERRUN = """
import torch
from gsparc.ops import SphereGrid, composite, make_plan
def test_a_box_that_leaves_the_image():
    means = torch.tensor([[2.0, 0.1, 0.5]])
    model = (means, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.3), torch.tensor([0.5]))
    plan = make_plan(*model, POSE, SphereGrid.hemisphere(8, 16))
    plan.buffers[2][0, 0] = 100_000_000  # the Gaussian at this rank
    composite(plan, *model, torch.ones(1, 1))
"""


# The build takes seven processor minutes, beside other tests
pytestmark = pytest.mark.timeout(1500)


def build() -> Path:
    """The sanitized module; made again when a source has changed."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES)).hexdigest()[:16]
    folder = ROOT / "build" / f"sanitized-{digest}"
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    given = [
        "-DGSPARC_SANITIZE=ON",
        f"-DPython_EXECUTABLE={sys.executable}",
        "-DCMAKE_BUILD_TYPE=Release",
    ]
    folder.parent.mkdir(exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):  # of processes of tests one builds
        found = list(folder.glob("ops/csrc/_native*.so"))
        for command in (
            (["-S", ROOT, "-B", folder, *given], ["--build", folder, "-j2"]) if not found else ()
        ):
            subprocess.run(
                ["cmake", *command], check=True, capture_output=True, env=environment, timeout=900
            )
    return next(folder.glob("ops/csrc/_native*.so"))


def library(name: str) -> str:
    return subprocess.check_output(["g++", f"-print-file-name={name}"], text=True).strip()


def watched(module: Path, isa: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """pytest on the sanitized module; leaks are Python's own, so they are not looked for."""
    environment = {
        **os.environ,
        "LD_PRELOAD": f"{library('libasan.so')} {library('libstdc++.so')}",
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:detect_odr_violation=0",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "OMP_NUM_THREADS": "2",
    }
    given = [str(module), isa, "-q", "-s", "-p", "no:cacheprovider", *arguments]
    command = [sys.executable, "tests/helpers/sanitized.py", *given]
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900
    )


@pytest.fixture(scope="module")
def module() -> Path:
    if shutil.which("cmake") is None or shutil.which("g++") is None:
        pytest.skip("cmake and g++ are needed to build the kernels with sanitizers")
    if not os.path.isabs(library("libasan.so")):
        pytest.skip("this compiler has no AddressSanitizer")
    return build()


@pytest.mark.slow
@pytest.mark.parametrize(
    "isa,others",  # tests that choose an instruction set themselves run once for it
    [
        pytest.param("baseline", ("avx2", "avx512"), marks=pytest.mark.rare),
        ("avx2", ("avx512",)),
        ("avx512", ("avx2", "baseline")),
    ],
    ids=["baseline", "avx2", "avx512"],
)
def test_nothing_is_found(module, isa, others):
    files = [f"tests/hard_cases/test_{case}.py" for case in CASES]
    ops = ("kernels", "compute_kernels", "queries")
    files += [f"tests/ops/test_{name}.py" for name in ops]
    left = " and ".join(f"not {word}" for word in ("shim", "forked", *others))
    done = watched(
        module,
        isa,
        *files,
        "-m",
        "not slow",
        "-k",
        f"{left} and (not reference or compute_kernels)",
    )
    if done.returncode == 99:
        pytest.skip(f"this machine has no {isa}")
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


@pytest.mark.slow
def test_an_overrun_is_seen(module, tmp_path):
    """Naive: the ordinary build may read beside its tensors and say nothing."""
    pose = "from gsparc.ops import Pose\nPOSE = Pose.identity(torch.zeros(3))\n"
    path = tmp_path / "test_overrun.py"
    path.write_text(OVERRUN.replace("def test", pose + "def test", 1))
    done = watched(module, "baseline", str(path))
    assert done.returncode != 0 and "AddressSanitizer" in done.stderr, done.stderr[-2000:]
