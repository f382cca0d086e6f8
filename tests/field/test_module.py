import dataclasses

import numpy as np
import torch
from modules import module

from gsparc.field.confidence import weighted_loss


def test_the_loss_is_weighted_by_confidence_per_sample(campaign, tmp_path):
    data = campaign("spectrum")
    batch = data.batch(np.arange(6))
    sure = module(data, tmp_path)
    task = sure.task_loss(sure.model(batch.tx, batch.rx).mean, batch)
    exponent = sure.model.confidence.exponent(batch.tx)
    assert torch.allclose(sure.training_step(batch, 0), weighted_loss(task, exponent, 0.3).mean())
    plain = module(data, tmp_path, confidence=False)
    assert torch.allclose(plain.training_step(batch, 0), task.mean())


def test_what_was_not_measured_pulls_at_nothing(campaign, tmp_path):
    """A masked spectrum's holes hold anything; they must not be learned."""
    data = campaign("spectrum")
    batch = data.batch(np.arange(3))
    mask = torch.zeros_like(batch.target, dtype=torch.bool)
    mask[:, :, :12] = True
    trained = module(data, tmp_path)
    one = dataclasses.replace(batch, mask=mask)
    other = dataclasses.replace(one, target=torch.where(mask, batch.target, 0.25))
    losses = [trained.training_step(b, 0).item() for b in (one, other)]
    assert losses[0] == losses[1]
    assert losses[0] != trained.training_step(batch, 0).item()


def test_every_parameter_learns(campaign, tmp_path):
    for kind in ("spectrum", "csi", "rssi"):
        data = campaign(kind)
        trained = module(data, tmp_path)
        trained.training_step(data.batch(np.arange(8)), 0).backward()
        silent = [
            n for n, p in trained.model.named_parameters() if p.grad is None or not p.grad.any()
        ]
        # From an isotropic start a turn changes nothing;
        # powers of one pose have no place in the image.
        assert set(silent) <= {"gaussians.quats"}, kind
