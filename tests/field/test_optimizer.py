import pytest
import torch

from gsparc.field.optimizer import (
    OptimizerSettings,
    optimizer_for,
    rate_factor,
    rate_kind,
    scheduler_for,
)

SETTINGS = OptimizerSettings(positions=1e-3, positions_final=1e-5, decay=0.1)


def test_positions_fall_exponentially_the_rest_along_a_cosine():
    assert rate_factor("positions", SETTINGS, 0, 100) == 1
    assert rate_factor("positions", SETTINGS, 50, 100) == pytest.approx(0.1)
    assert rate_factor("positions", SETTINGS, 100, 100) == pytest.approx(0.01)
    assert rate_factor("emission", SETTINGS, 0, 100) == 1
    assert rate_factor("emission", SETTINGS, 50, 100) == pytest.approx(0.55)
    for step in (100, 1000):  # a run that goes on stays at the final rate
        assert rate_factor("emission", SETTINGS, step, 100) == pytest.approx(0.1)
        assert rate_factor("positions", SETTINGS, step, 100) == pytest.approx(0.01)


def test_positions_that_do_not_learn():
    assert rate_factor("positions", OptimizerSettings(positions=0.0), 3, 10) == 0


def test_warmup_rises_to_the_full_rate():
    slow = OptimizerSettings(warmup=4, decay=1.0)
    assert [rate_factor("emission", slow, k, 100) for k in range(5)] == [0.25, 0.5, 0.75, 1, 1]


def test_every_parameter_has_its_rate():
    assert rate_kind("gaussians.means") == "positions"
    assert rate_kind("confidence.network.0.weight") == "confidence"
    with pytest.raises(KeyError, match=r"gsparc\.field\.optimizer\.KINDS"):
        rate_kind("gaussians.means_too")


def test_one_tensor_per_group_at_its_own_rate(campaign):
    model = torch.nn.ModuleDict(
        {"emission": torch.nn.Linear(2, 3), "confidence": torch.nn.Linear(1, 1)}
    )
    model["confidence"].bias.requires_grad_(False)
    optimizer = optimizer_for(model, OptimizerSettings(emission=0.3, confidence=0.7, decay=0.5))
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert rates == {"emission.weight": 0.3, "emission.bias": 0.3, "confidence.weight": 0.7}
    assert all(len(group["params"]) == 1 for group in optimizer.param_groups)
    scheduler = scheduler_for(optimizer, OptimizerSettings(decay=0.5), 10)
    for _ in range(10):
        optimizer.step()
        scheduler.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.15)
