"""Nobody there, in training: everything is pruned, or nothing is seen.

Remedy: pruning has a floor and keeps the most opaque; empty plans are plans. Shown: a run that
would prune every Gaussian ends with the floor; a run whose Gaussians are all behind the horizon,
and one that starts without any, finish with finite figures.
"""

import numpy as np
import pytest
from campaigns import brief, channels, compose, powers, spectra

from gsparc.commands.train import train

PRUNE = (
    # Of emissions that were solved for, no Gaussian goes that changes what is rendered
    "init=sphere",
    "callbacks=densify",
    "callbacks.densify.start=4",
    "callbacks.densify.interval=4",
    "callbacks.densify.stop=20",
    "callbacks.densify.min_opacity=2.0",  # everyone is below
    "callbacks.densify.min_gaussians=5",
    "callbacks.densify.grad_threshold=1e9",
)


def test_pruning_stops_at_the_floor(tmp_path):
    facts, objects = train(compose(*brief(spectra(tmp_path / "own.npz"), *PRUNE)), tmp_path / "run")
    assert facts["model/num_gaussians"] == 5 and np.isfinite(facts["test/psnr_db"])
    opacities = objects.methods[0].fitted_model().gaussians.opacities
    assert (opacities < 2.0).all()


@pytest.mark.parametrize("maker", [spectra, channels, powers])
def test_no_gaussians_at_all(tmp_path, maker):
    file = maker(tmp_path / "own.npz")
    settings = brief(file, "init=uniform", "model.field.count=0", "callbacks=densify")
    facts, _ = train(compose(*settings), tmp_path / "run")
    if maker is powers:  # whose mean knows more than silence: it answers
        assert facts["model/refused"].endswith("the plain mean answers") and facts["test/nmse"] < 1
        return
    assert facts["model/num_gaussians"] == 0
    assert facts["test/nmse"] == pytest.approx(1.0)  # silence
