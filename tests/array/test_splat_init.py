"""Splatted field with an array response on known array vectors: closed-form start, then training."""

from __future__ import annotations

import numpy as np
import pytest
from campaigns import compose
from contexts import short

from gsparc.data.splits import Fold
from gsparc.methods.registry import build


def _trained(data, fold, folder, *overrides: str, steps: int = 10):
    method = build(compose("logger=none", *overrides).model)
    method.fit(data, fold, short(folder, steps, 16, validate_every=steps))
    return method


def test_splat_then_a_learns_what_the_array_measured(known_campaign, tmp_path):
    data, _ = known_campaign
    order = np.random.default_rng(0).permutation(160)
    fold = Fold(np.sort(order[64:]), np.sort(order[32:64]), np.sort(order[:32]))
    overrides = ["model.effects.array=splat", "model.field.count=120", "model.refit=false"]
    method = _trained(data, fold, tmp_path, *overrides, steps=10)
    batch = data.batch(fold.test)
    said = method.predict(batch.tx, batch.rx)
    error = float((said.mean - batch.target).square().mean())
    nearest = np.abs(data.moving[fold.test][:, None] - data.moving[fold.train][None]).sum(-1).argmin(1)
    rival = float((data.targets(fold.train[nearest]) - batch.target).square().mean())
    assert error < 0.5 * rival and method.effects == "array (splat)"
    assert ((said.confidence >= 0) & (said.confidence <= 1)).all()


def test_a_closed_form_that_cannot_be_is_refused(known_campaign, tmp_path):
    data, _ = known_campaign
    fold = Fold(np.arange(20), np.arange(20, 24), np.arange(24, 30))
    for setting in ("emission.hidden=4", "attenuation.inverse_distance=true"):
        with pytest.raises(ValueError, match="solves a linear read-out"):
            _trained(
                data, fold, tmp_path, "model.effects.array=splat", "model.warm_start=true",
                "model.field.count=20", f"model.{setting}",
            )  # fmt: skip
