import pytest

from gsparc.field.optimizer import (
    OptimizerSettings,
    rate_factor,
    rate_kind,
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
