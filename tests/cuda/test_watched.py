"""The CUDA kernels on the host shim under sanitizers: races within a block, memory beside a tensor.

ThreadSanitizer is told which of a block's threads runs and what a barrier orders, so it reports
memory that two of them share without a barrier between, whatever the order they happened to run in.
A shuffle orders nothing.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from rasters import GRIDS, origin, poses, random_scene, render
from shim import INCLUDES, KEPT, SHIM, fingerprint, serving

from gsparc.ops import SphereGrid, calls, cuda_library, freeze, make_plan, mean_weights

REPLAY = Path(__file__).parent / "replay.cpp"
THREADS = ("-fsanitize=thread",)
MEMORY = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
ENDS = {"TSAN_OPTIONS": "exitcode=66:halt_on_error=1", "ASAN_OPTIONS": "detect_leaks=0"}

SMALL = SphereGrid.full_sphere(8, 24)

RACE = """
#include <cstdlib>
#include "cuda/device.h"
using namespace gsparc::device;
void kernel(int* out, int way, int reach) {
    __shared__ int left[64];
    left[threadIdx.x] = threadIdx.x;
    if (way == 1) warp_sync();
    if (way == 2) block_sync();
    if (way == 3) warp_any(true);
    out[threadIdx.x] = left[threadIdx.x ^ reach];
}
int main(int, char** arguments) {
    int out[64];
    return launch(kernel, 2, 1, 64, nullptr, out, *arguments[1] - '0', std::atoi(arguments[2]));
}
"""
NOTHING, WARP, BLOCK, SHUFFLE = "0123"
OVERRUN = """
#include "cuda/device.h"
using namespace gsparc::device;
void kernel(int* out) { out[threadIdx.x + 1] = 1; }
int main() { return launch(kernel, 1, 1, 64, nullptr, new int[64]); }
"""


def compiled(path: Path, watch: tuple[str, ...], *sources: str) -> Path:
    """An executable of watched sources over a shim that is not watched itself."""
    common = ["g++", "-std=c++17", "-O1", "-g1", "-ffp-contract=off", *INCLUDES]
    defines = ["-DGSPARC_WATCHED", *(["-DGSPARC_WATCH_THREADS"] if watch == THREADS else [])]
    path.parent.mkdir(parents=True, exist_ok=True)
    parts = []
    for number, source in enumerate([*sources, str(SHIM)]):
        parts.append(str(path.with_suffix(f".{number}.o")))
        instrument = () if source == str(SHIM) else watch
        command = [*common, *defines, *instrument, "-x", "c++", "-c", source, "-o", parts[-1]]
        subprocess.run(command, check=True, capture_output=True, text=True)
    subprocess.run(
        [*common, *watch, *parts, "-o", str(path)], check=True, capture_output=True, text=True
    )
    return path


def ends(*command: str) -> subprocess.CompletedProcess[str]:
    """How a watched program ends; ThreadSanitizer does not bear memory laid out at random."""
    still = [shutil.which("setarch") or "setarch", "-R"]
    return subprocess.run(
        [*still, *command], capture_output=True, text=True, env={**os.environ, **ENDS}
    )


@contextmanager
def recording(path: Path) -> Iterator[None]:
    """Every call of the kernels goes into a file as replay.cpp reads it, then runs."""
    run = calls.launch

    def kept(name, like, *tensors, **numbers):
        call = calls.make_call(like, **numbers)
        with path.open("ab") as file:
            file.write(
                name.encode().ljust(32, b"\0") + bytes(call) + len(tensors).to_bytes(8, "little")
            )
            for tensor in tensors:
                flat = None if tensor is None else tensor.detach().reshape(-1).view(torch.uint8)
                size = -1 if flat is None else len(flat)
                file.write(size.to_bytes(8, "little", signed=True))
                file.write(b"" if flat is None else flat.numpy().tobytes())
        return run(name, like, *tensors, **numbers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calls, "launch", kept)
        yield


def everything(dtype: torch.dtype) -> None:
    """Each kernel: both projections, one pose and several, few and many channels,
    long and short lists.
    """
    for projection in ("tangent", "equirect"):
        for count in (0, 3):
            scene = random_scene(n=30).to(dtype)
            render(scene, poses(count), GRIDS["patch"], projection=projection)
        scene = random_scene(n=150, seed=12, size=1.5).to(dtype)
        model = (scene.means, scene.quats, scene.scales, 0.3 * scene.opacities)
        plan = make_plan(
            *model, origin(), SMALL, projection=projection, ids=torch.arange(150).flip(0)
        )
        leaves = [tensor.clone().requires_grad_() for tensor in model]
        seen = mean_weights(plan, *leaves)
        (seen.mean.sum() + seen.share.sum()).backward()
        view = freeze(plan, *model, version=0)
        for channels in (2, 21):
            view.render(torch.ones(150, channels, dtype=dtype), 0)
            raster = random_scene(n=30, channels=channels).to(dtype)
            render(raster, origin(), SMALL, projection=projection)


def test_every_kernel_runs(where):
    """What compute-sanitizer watches on a GPU (bench/gpu.sh)."""
    everything(torch.float32)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("calls") / "calls"
    with serving("shim"), recording(path):
        for dtype in (torch.float32, torch.float64):
            everything(dtype)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("watch", [THREADS, MEMORY], ids=["threads", "memory"])
def test_watched_kernels_have_nothing_to_report(watch, record):
    path = KEPT / f"watched-{fingerprint(*watch, REPLAY.read_text())}"
    if not path.exists():
        compiled(path, watch, *cuda_library.cuda_sources(), str(REPLAY))
    done = ends(str(path), str(record))
    assert done.returncode == 0, done.stdout + done.stderr[:4000]
    assert int(done.stdout.split()[0]) > 60


@pytest.mark.slow
def test_shared_memory_without_a_barrier_is_reported(tmp_path):
    """Neighbours in a warp need its barrier, warps that of the block; a shuffle is not one."""
    source = tmp_path / "race.cpp"
    source.write_text(RACE)
    program = str(compiled(tmp_path / "race", THREADS, str(source)))
    for reach, enough in (("1", {WARP, BLOCK}), ("32", {BLOCK})):
        for way in (NOTHING, WARP, BLOCK, SHUFFLE):
            done = ends(program, way, reach)
            told = done.returncode == 66 and "data race" in done.stderr
            assert told != (way in enough), (reach, way, done.returncode, done.stderr[:2000])


def test_memory_beside_a_tensor_is_reported(tmp_path):
    source = tmp_path / "overrun.cpp"
    source.write_text(OVERRUN)
    done = ends(str(compiled(tmp_path / "overrun", MEMORY, str(source))))
    assert done.returncode != 0 and "heap-buffer-overflow" in done.stderr
