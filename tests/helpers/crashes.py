"""Runs in a process of their own that may be killed:
forked from a server that has imported everything once.

Equivalent to starting the command and killing it,
except that 50 kills do not cost 50 imports of torch.
"""

import contextlib
import json
import multiprocessing
import os
import random
import resource
import signal
import time
from pathlib import Path
from unittest import mock

from states import different

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "crashes",
        "campaigns",
        "gsparc.commands.train",
        "gsparc.models.splat.method",
        "gsparc.callbacks",
    ]
)


STEPS = 42  # a multiple of 7: the last checkpoint of a stage is its end
DENSIFIED = (
    f"trainer.max_steps={STEPS}",
    "init=uniform",  # after a closed form few edits are taken
    "callbacks.checkpoint.interval=7",  # in the middle of an interval
    "trainer.val_check_interval=20",
    "callbacks=densify",
    "callbacks.densify.start=10",
    "callbacks.densify.interval=10",
    "callbacks.densify.stop=35",
    "callbacks.densify.grad_threshold=1e-5",
    "callbacks.densify.max_gaussians=200",
    "callbacks.reset.interval=20",
)
DRAWING = "gsparc.pictures.pictures.draw_predictions"  # half of the seconds of a short run
VARYING = ("time/", "machine/", "memory/", "git", "run_id")
TIMED = ("train_s", "render_ms", "ratio_to_copy")


def training(folder: str, overrides: list[str]) -> None:
    """`train.py` with these overrides into `folder`; errors are one line in `error.txt`."""
    import torch
    from campaigns import compose

    from gsparc.commands.train import train
    from gsparc.evaluation.console import error_in_one_line

    torch.set_num_threads(1)
    with mock.patch(DRAWING):
        try:
            train(compose(*overrides), Path(folder))
        except Exception as error:
            Path(folder, "error.txt").write_text(error_in_one_line(error))
            os._exit(1)
    os._exit(0)


def small_campaign(rows: int):
    """`rows` receivers in a box, four to a shard; spectra of 18 x 36."""
    from gsparc.simulate.effects import Effects
    from gsparc.simulate.scenes.settings import SceneSettings
    from gsparc.simulate.settings import CampaignSettings
    from gsparc.simulate.spectrum import SpectrumSettings

    scene = SceneSettings(
        name="box",
        transmitter_m=(1.0, 1.5, 2.6),
        area_m=((0.2, 0.2), (5.8, 4.8)),
        height_m=(1.1, 1.5),
        num_receivers=rows,
        carrier_hz=2.4e9,
        bandwidth_hz=40e6,
        subcarriers=4,
        room={"size_m": [6, 5, 3], "reflection": -0.6, "boxes_m": [[[2.6, 2.2, 0], [3.0, 2.6, 3]]]},
    )
    effects = Effects(
        refraction=False,
        diffraction=False,
        edge_diffraction=False,
        diffuse=False,
        polarisation=False,
    )
    spectrum = SpectrumSettings(height=18, width=36, rows=4, columns=4)
    return CampaignSettings(scene=scene, effects=effects, spectrum=spectrum, shard=4)


class Limited:
    """No file may grow beyond so many bytes: what a full disk does, without filling one.
    0 is no limit.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most = most_bytes

    def __enter__(self) -> None:
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)
        if self.most:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.most, self.before[1]))

    def __exit__(self, *unused: object) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)


def run(target, *arguments) -> tuple[int, float]:
    """Exit code and seconds of an undisturbed run; the server has imported everything before."""
    first = CONTEXT.Process(target=int)
    first.start()
    first.join()
    child = CONTEXT.Process(target=target, args=arguments)
    began = time.monotonic()
    child.start()
    child.join(timeout=300)
    return int(child.exitcode if child.exitcode is not None else -1), time.monotonic() - began


def killed(target, *arguments, after_s: float) -> bool:
    """SIGKILL a run after so many seconds; False when it had ended by itself."""
    child = CONTEXT.Process(target=target, args=arguments)
    child.start()
    child.join(timeout=after_s)
    return _kill(child)


def _kill(child: multiprocessing.Process) -> bool:
    if child.exitcode is None:
        os.kill(child.pid, signal.SIGKILL)
        child.join()
    if child.exitcode != -signal.SIGKILL:  # it ended before, or just now
        assert child.exitcode == 0, f"it failed by itself: {child.exitcode}"
        return False
    return True


def killed_at(file: Path, saves: int, target, *arguments, after_s: float = 0.0) -> int:
    """SIGKILL a run once `file` has been written `saves` times and `after_s` more;
    the step it holds.
    """
    from gsparc.models import checkpoint

    seen: set[int] = set()
    child = CONTEXT.Process(target=target, args=arguments)
    child.start()
    while len(seen) < saves:
        assert child.is_alive(), f"it ended before: {child.exitcode}"
        with contextlib.suppress(FileNotFoundError):
            seen.add(file.stat().st_mtime_ns)
        time.sleep(0.001)
    time.sleep(after_s)
    assert _kill(child), "it had finished before the kill"
    return checkpoint.read(file).extra["trainer"]["global_step"]


def moments(count: int, longest_s: float, seed: int) -> list[float]:
    """Random moments of a run of that length [s],
    early enough that runs which go on are still running.
    """
    draw = random.Random(seed)
    return [draw.uniform(0.02, 0.5 * longest_s) for _ in range(count)]


def last_checkpoint(folder: Path) -> list[str]:
    """The override that goes on: from the refit when it has begun to leave checkpoints."""
    left = [p for p in (folder / "refit" / "last.ckpt", folder / "last.ckpt") if p.exists()]
    return [f"ckpt_path={left[0]}"] if left else []


def assert_same(whole: Path, resumed: Path) -> None:
    """Figures, model, optimizer and gathered statistics of two runs are identical."""
    from gsparc.models import checkpoint

    folders, facts = (whole, resumed), []
    for folder in folders:
        every = json.loads((folder / "summary.json").read_text()).items()
        facts.append(
            {k: v for k, v in every if not k.startswith(VARYING) and not any(t in k for t in TIMED)}
        )
    assert facts[0] == facts[1]
    assert different(*(checkpoint.read(folder / "model.ckpt").state for folder in folders)) == []
    last = [checkpoint.read(folder / "refit" / "last.ckpt").extra["trainer"] for folder in folders]
    assert different(*(state["optimizer_states"] for state in last), "optimizer") == []
    gathered = [state["callbacks"]["Densify"] for state in last]
    assert different(*gathered, "statistics") == [] and gathered[0]["statistics"]["seen"].any()
