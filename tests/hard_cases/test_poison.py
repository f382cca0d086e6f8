"""Poison: a NaN in a target or a parameter during training.

Remedy: the loss is looked at before the step; a run that meets a NaN or an infinity stops, names sample or
Gaussian, leaves batch and parameters on disk, and keeps the last good checkpoint. Never silently zeroed.
The rasterizer's door refuses what is not finite or would overflow inside. Exact: refused, or finite.
"""

from __future__ import annotations

import dataclasses

import lightning.pytorch as L
import numpy as np
import pytest
import torch
from campaigns import brief, compose, spectra
from contexts import short
from rasters import GRIDS, origin, random_scene, render

from gsparc.models import checkpoint
from gsparc.models.registry import build
from gsparc.ops.settings import FARTHEST, WIDEST
from gsparc.training.module import NonFiniteLoss


class Spoil(L.Callback):
    """Writes a NaN into one Gaussian in the middle of training."""

    def __init__(self, step: int, name: str, row: int) -> None:
        self.step, self.name, self.row = step, name, row

    def on_train_batch_start(self, trainer, module, *unused):
        if trainer.global_step == self.step:
            with torch.no_grad():
                dict(module.model.named_parameters())[self.name][self.row] = float("nan")


def fit(data, fold, file, callbacks, **more) -> None:
    method = build(compose(*brief(file, "model.refit=false")).model)
    method.fit(data, fold, short(file.parent, 20, callbacks=lambda: list(callbacks), every=5, **more))


@pytest.fixture
def data(tmp_path):
    from gsparc.data.load import load

    return load({"name": "own", "file": str(spectra(tmp_path / "own.npz"))})


@pytest.mark.parametrize(
    "name", ["gaussians.means", "gaussians.opacity_logits", "emission.weight2", "emission.bias2"]
)
def test_a_spoilt_parameter_stops_the_run_and_is_named(data, folds, tmp_path, name):
    with pytest.raises(NonFiniteLoss, match=rf"at step 7 .*Gaussian id 3, {name}"):
        fit(data, folds(len(data)).folds[0], tmp_path / "own.npz", [Spoil(7, name, 3)])
    left = torch.load(tmp_path / "nonfinite.pt", weights_only=True)
    assert left["step"] == 7 and left["state_dict"][name][3].isnan().any() and len(left["index"])
    assert left["offender"] == f"Gaussian id 3, {name}" and left["sample"] in left["index"]
    good = checkpoint.read(tmp_path / "last.ckpt")
    assert good.extra["trainer"]["global_step"] == 5
    assert all(t.isfinite().all() for t in good.state["inner"]["model"].values())


class SpoilAfterStep(Spoil):
    """The same between a step and whatever comes before the next: a validation, a checkpoint."""

    def on_train_batch_start(self, *unused):
        pass

    def on_train_batch_end(self, trainer, module, *unused):
        Spoil.on_train_batch_start(self, trainer, module)


def test_a_poisoned_state_replaces_no_checkpoint(data, folds, tmp_path):
    """A NaN that a step itself makes is met one step later; a checkpoint must not be written in between."""
    with pytest.raises(NonFiniteLoss, match="log_gain"):
        fit(data, folds(len(data)).folds[0], tmp_path / "own.npz", [SpoilAfterStep(10, "log_gain", ...)])
    assert checkpoint.read(tmp_path / "last.ckpt").extra["trainer"]["global_step"] == 5
    assert torch.load(tmp_path / "nonfinite.pt", weights_only=True)["offender"] == "log_gain"


def test_a_parameter_that_would_overflow_stops_the_run_too(data, folds, tmp_path):
    """Finite, but a Gaussian of 1e30 m: found when the rasterizer's door got limits."""

    class Widen(Spoil):
        def on_train_batch_start(self, trainer, module, *unused):
            if trainer.global_step == self.step:
                with torch.no_grad():
                    module.model.gaussians.log_scales[self.row] = 70.0

    with pytest.raises(NonFiniteLoss, match=r"at step 7 .*Gaussian id 3: Gaussian 3 has scales that are not"):
        fit(data, folds(len(data)).folds[0], tmp_path / "own.npz", [Widen(7, "", 3)])
    left = torch.load(tmp_path / "nonfinite.pt", weights_only=True)
    assert "Gaussian id 3" in left["offender"] and len(left["target"]) == len(left["index"])
    assert checkpoint.read(tmp_path / "last.ckpt").extra["trainer"]["global_step"] == 5


def test_a_run_that_is_poisoned_before_a_validation_leaves_the_evidence_too(data, folds, tmp_path):
    with pytest.raises(NonFiniteLoss, match=r"Gaussian id 2, gaussians\.means"):
        fit(
            data,
            folds(len(data)).folds[0],
            tmp_path / "own.npz",
            [SpoilAfterStep(9, "gaussians.means", 2)],
            validate_every=10,
        )
    assert (tmp_path / "nonfinite.pt").exists()


def test_a_spoilt_target_stops_the_run_and_its_sample_is_named(data, folds, tmp_path):
    fold = folds(len(data)).folds[0]
    target = data.target.astype(np.float32).copy()
    bad = int(fold.train[4])
    target[bad, 3, 3] = np.nan
    method = build(compose(*brief(tmp_path / "own.npz", "init=sphere")).model)
    method.settings = dataclasses.replace(
        method.settings,
        emission=dataclasses.replace(
            method.settings.emission,
            encoding=dataclasses.replace(method.settings.emission.encoding, kind="raw"),
        ),
    )
    with pytest.raises(NonFiniteLoss, match=rf"sample {bad}; all parameters are finite"):
        method.fit(dataclasses.replace(data, target=target), fold, short(tmp_path, 20))
    assert (tmp_path / "nonfinite.pt").exists()


@pytest.mark.parametrize("name,value", [("means", 1e7), ("means", 1e38), ("scales", 2e5), ("scales", 1e38)])
def test_what_overflows_inside_is_refused_at_the_rasterizers_door(backend, name, value):
    scene = random_scene(n=5).to(torch.float32)
    getattr(scene, name)[3] = value
    with pytest.raises(ValueError, match=f"Gaussian 3 has {name} that are not finite and"):
        render(scene, origin(), GRIDS["patch"], backend)


@pytest.mark.parametrize("name,value", [("means", FARTHEST), ("scales", WIDEST), ("quats", 3e38)])
@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_what_is_just_let_in_stays_finite(backend, projection, name, value):
    scene = random_scene(n=5).to(torch.float32)
    getattr(scene, name)[3] = value
    got = render(scene, origin(), GRIDS["hemisphere"], backend, projection=projection, compensate=False)
    assert all(found.isfinite().all() for found in got.values())


def test_squares_of_what_is_refused_overflow():
    """Naive: only NaN and infinities are refused; the length of a vector of 1e20 is infinite in float32."""
    assert torch.full((3,), 1e20).square().sum().isinf()


def test_zeroing_the_gradient_hides_it():
    """Naive (the published implementation): NaN gradients of the means become 0 and training goes on."""
    mean = torch.tensor([1.0], requires_grad=True)
    loss = (mean * float("nan")).sum()
    loss.backward()
    assert torch.nan_to_num(mean.grad).item() == 0 and not torch.isfinite(loss)
