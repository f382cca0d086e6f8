"""Poison: a NaN in a target or a parameter during training.

Remedy: the loss is looked at before the step; a run that meets a NaN or an infinity stops, names
sample or Gaussian, leaves batch and parameters on disk, and keeps the last good checkpoint. Never
silently zeroed. The rasterizer's door refuses what is not finite or would overflow inside. Exact:
refused, or finite.
"""

import dataclasses
import math
import re

import lightning.pytorch as L
import numpy as np
import pytest
import torch
from campaigns import brief, compose, spectra
from contexts import loaded, short, trained
from rasters import GRIDS, origin, random_scene, render

from gsparc.field.module import NonFiniteLoss
from gsparc.models import checkpoint
from gsparc.models.registry import build


class Spoil(L.Callback):
    """Writes `value` into a parameter (of one Gaussian) before a step, or `after` it.

    After it whatever comes before the next step meets it: a validation, a checkpoint.
    """

    def __init__(
        self, step: int, name: str, row: object, value: float = math.nan, after: bool = False
    ) -> None:
        self.step, self.name, self.row, self.value, self.after = step, name, row, value, after

    def write(self, trainer, module) -> None:
        if trainer.global_step == self.step:
            with torch.no_grad():
                dict(module.model.named_parameters())[self.name][self.row] = self.value

    def on_train_batch_start(self, trainer, module, *unused):
        if not self.after:
            self.write(trainer, module)

    def on_train_batch_end(self, trainer, module, *unused):
        if self.after:
            self.write(trainer, module)


@pytest.mark.parametrize(
    "spoil,offender,named",
    [
        *(
            (Spoil(7, name, 3), f"Gaussian id 3, {name}", "at step 7 .*")
            for name in (
                "gaussians.means",
                "gaussians.opacity_logits",
                "emission.weight2",
                "emission.bias2",
            )
        ),
        # A NaN that a step itself makes is met one step later; no checkpoint is written in between.
        (Spoil(10, "log_gain", ..., after=True), "log_gain", ""),
        # Finite, but a Gaussian of 1e30 m: found when the rasterizer's door got limits.
        (
            Spoil(7, "gaussians.log_scales", 3, 70.0),
            "Gaussian id 3: Gaussian 3 has scales that are not",
            "at step 7 .*",
        ),
        # Before a validation the evidence is left, too.
        (Spoil(9, "gaussians.means", 2, after=True), "Gaussian id 2, gaussians.means", ""),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_spoilt_parameter_stops_the_run_and_is_named(tmp_path, spoil, offender, named):
    with pytest.raises(NonFiniteLoss, match=named + re.escape(offender)):
        trained(
            spectra(tmp_path / "own.npz"),
            tmp_path,
            20,
            callbacks=lambda: [spoil],
            every=5,
            validate_every=10 if spoil.step == 9 else 500,
        )
    left = torch.load(tmp_path / "nonfinite.pt", weights_only=True)
    assert left["offender"].startswith(offender) and len(left["target"]) == len(left["index"])
    assert left["step"] >= 7 and (spoil.step != 7 or left["step"] == 7)
    spoilt = left["state_dict"][spoil.name][spoil.row]
    assert spoilt.isnan().any() or (spoilt == spoil.value).all()
    good = checkpoint.read(tmp_path / "last.ckpt")
    assert good.extra["trainer"]["global_step"] == 5
    assert all(t.isfinite().all() for t in good.state["inner"]["model"].values())


def test_a_spoilt_target_stops_the_run_and_its_sample_is_named(tmp_path):
    data, fold = loaded(spectra(tmp_path / "own.npz"))
    target = data.target.astype(np.float32).copy()
    bad = int(fold.train[4])
    target[bad, 3, 3] = np.nan
    method = build(compose(*brief(tmp_path / "own.npz", "init=sphere")).model).create_for(data)
    settings = method.settings
    encoding = dataclasses.replace(settings.emission.encoding, kind="raw")
    emission = dataclasses.replace(settings.emission, encoding=encoding)
    method.settings = dataclasses.replace(settings, emission=emission)
    with pytest.raises(NonFiniteLoss, match=rf"sample {bad}; all parameters are finite"):
        method.fit(dataclasses.replace(data, target=target), fold, short(tmp_path, 20))
    assert (tmp_path / "nonfinite.pt").exists()


@pytest.mark.parametrize(
    "name,value", [("means", 1e7), ("means", 1e38), ("scales", 2e5), ("scales", 1e38)]
)
def test_what_overflows_inside_is_refused_at_the_rasterizers_door(backend, name, value):
    scene = random_scene(n=5).to(torch.float32)
    getattr(scene, name)[3] = value
    with pytest.raises(ValueError, match=f"Gaussian 3 has {name} that are not finite and"):
        render(scene, origin(), GRIDS["patch"], backend)
