from types import SimpleNamespace

import pytest
import torch

from gsparc.callbacks import OpacityReset
from gsparc.field.gaussians import GaussianField


@pytest.fixture
def module():
    field = GaussianField(torch.zeros(4, 3), torch.ones(4, 3), 0.5)
    with torch.no_grad():
        field.opacity_logits.copy_(torch.tensor([3.0, 0.0, -9.0, 5.0]))
    model = SimpleNamespace(gaussians=field)
    return SimpleNamespace(model=model, total_steps=60, global_step=0, solved=False)


def trainer(module, step: int) -> SimpleNamespace:
    logits, module.global_step = module.model.gaussians.opacity_logits, step
    optimizer = torch.optim.Adam([logits])
    logits.grad = torch.ones_like(logits)
    kept = logits.detach().clone()
    optimizer.step()
    with torch.no_grad():
        logits.copy_(kept)
    return SimpleNamespace(optimizers=[optimizer], loggers=[])


def test_opaque_ones_are_lowered_and_forget_their_momentum(module):
    run = trainer(module, 30)
    OpacityReset(interval=30, stop=100, ceiling=0.01, least_steps=0).on_train_batch_start(
        run, module
    )
    field = module.model.gaussians
    want = torch.tensor([0.01, 0.01, torch.sigmoid(torch.tensor(-9.0)), 0.01])
    assert torch.allclose(field.opacities, want)
    state = run.optimizers[0].state[field.opacity_logits]
    assert state["exp_avg"].bool().tolist() == [False, False, True, False]
    assert state["exp_avg_sq"].bool().tolist() == [False, False, True, False]
    assert int(field.version) == 1  # frozen views are stale


def test_no_reset_that_the_run_is_too_short_to_recover_from(module, caplog):
    """The first reset of the paper's recipe took 8 dB from the validation of a short run."""
    caplog.set_level("INFO")
    OpacityReset(interval=30, stop=100, least_steps=0).on_train_batch_start(
        trainer(module, 60), module
    )
    assert int(module.model.gaussians.version) == 0
    assert "no opacity reset at step 60: 0 steps are too few to recover in" in caplog.text


@pytest.mark.parametrize(
    ("step", "solved", "least"),
    [
        *((step, False, 0) for step in (0, 29, 31, 120)),
        (30, True, 0),
        (30, False, 61),  # of a training too short for any: one at step 60 of 400 took 9 dB of 21.8
    ],
)
def test_only_on_schedule_and_never_of_opacities_that_emissions_were_solved_for(
    module, step, solved, least
):
    before, module.solved = module.model.gaussians.opacity_logits.detach().clone(), solved
    OpacityReset(interval=30, stop=100, least_steps=least).on_train_batch_start(
        trainer(module, step), module
    )
    assert torch.equal(module.model.gaussians.opacity_logits, before)
    assert int(module.model.gaussians.version) == 0
