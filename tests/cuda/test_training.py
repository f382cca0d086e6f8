"""The same short training on the CPU and on a GPU: figures agree,
whatever kind of data takes steps.
"""

import pytest
from campaigns import brief, channels, compose, powers, spectra

from gsparc.commands.train import train
from gsparc.ops import cuda_library

REASON = cuda_library.missing_device()
DENSE = ("callbacks.densify.start=4", "callbacks.densify.interval=4", "callbacks.densify.stop=18")


def array(folder, *more):
    """Spectra of an array; Gaussians start in closed form."""
    data = ("dataset=rfid_sim", "dataset.count=40", f"dataset.root='{folder}'")
    steps = ("model.keep_best=false", "trainer.max_steps=10", "trainer.val_check_interval=5")
    return [
        *data,
        *steps,
        "~callbacks.pictures",
        "baselines=[mean]",
        "logger=none",
        "threads=1",
        *more,
    ]


def splat(file, *more):
    """Gaussians alone, of channels and powers."""
    return [
        "model=splat",
        *(word for word in brief(file, *more) if not word.startswith("model.effects")),
    ]


CASES = {
    "images": lambda folder: brief(spectra(folder / "own.npz"), *DENSE),
    "images of a moving receiver": lambda folder: brief(
        spectra(folder / "own.npz", moving="rx"), *DENSE
    ),
    "images in half precision": lambda f: brief(
        spectra(f / "own.npz"), "trainer.precision=bf16-mixed"
    ),
    "an array": array,
    "an array and more Gaussians": lambda folder: array(folder, *DENSE),
    "channels": lambda folder: splat(channels(folder / "own.npz")),
    "channels up to a phase": lambda f: splat(
        channels(f / "own.npz"), "model.loss.snapshot=phase_timing"
    ),
    "powers": lambda folder: splat(powers(folder / "own.npz")),
}


@pytest.mark.skipif(REASON is not None, reason=str(REASON))
@pytest.mark.parametrize("case", CASES)
def test_training_on_a_gpu_gives_the_figures_of_the_cpu(case, tmp_path):
    """`trainer=gpu` ended in "Expected all tensors to be on the same device"
    for spectra of an array.
    """
    own, there = (
        train(
            compose(*CASES[case](tmp_path), f"trainer.accelerator={accelerator}"),
            tmp_path / accelerator,
        )[0]
        for accelerator in ("cpu", "gpu")
    )
    figure = next(name for name in ("test/psnr_db", "test/rmse_db", "test/nmse") if name in own)
    # A moving receiver's steps are steep: SSIM in double precision moves its figure
    # by 1.3 % on a CPU alone.
    steep = case == "images of a moving receiver"
    assert there[figure] == pytest.approx(own[figure], rel=0.03 if steep else 0.01)
    assert there["model/num_gaussians"] == pytest.approx(
        own["model/num_gaussians"], abs=3 if steep else 0
    )
