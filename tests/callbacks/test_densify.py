from types import SimpleNamespace

import pytest
import torch

from gsparc.callbacks import Bounds, Densify
from gsparc.callbacks.densify import _sample_inside
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import GaussianModel, ModelSettings, Rendered
from gsparc.field.optimizer import OptimizerSettings, optimizer_for
from gsparc.ops import Pose

RECEIVER = Pose.identity(torch.tensor([4.0, 0.0, 0.0]))


EMISSION = EmissionSettings(EncodingSettings("raw"), hidden=2, activation="sigmoid", init_bias=0.0)


@pytest.fixture
def model(campaign) -> GaussianModel:
    torch.manual_seed(0)
    settings = ModelSettings(
        field=FieldSettings(count=10, placement="sphere", scale=0.1), emission=EMISSION
    )
    return GaussianModel(settings, campaign("spectrum").site, RECEIVER)


def draws() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def at(model: GaussianModel, step: int, total: int) -> SimpleNamespace:
    """A module at a step of its schedule."""
    return SimpleNamespace(model=model, total_steps=total, global_step=step, solved=False)


def with_gradient(densify: Densify, wanting: list[int], count: int = 10) -> Densify:
    gradient = torch.zeros(count)
    gradient[wanting] = 1.0
    densify.statistics = {
        "gradient": gradient,
        "seen": torch.ones(count),
        "radius": torch.ones(count),
    }
    return densify


def test_small_ones_are_cloned_in_place(model):
    densify = with_gradient(Densify(grad_threshold=0.5, size_share=1.0), [2, 7])
    edit = densify.plan(model, draws())
    assert edit.keep.all() and edit.parents.tolist() == [2, 7]
    assert torch.equal(edit.replace["gaussians.means"], model.gaussians.means[[2, 7]])
    assert torch.equal(edit.replace["gaussians.log_scales"], model.gaussians.log_scales[[2, 7]])


def test_large_ones_are_split_into_smaller(model):
    densify = with_gradient(Densify(grad_threshold=0.5, size_share=0.0, children=3), [4])
    edit = densify.plan(model, draws())
    assert edit.keep.tolist() == [i != 4 for i in range(10)] and edit.parents.tolist() == [4, 4, 4]
    scales = edit.replace["gaussians.log_scales"].exp()
    assert torch.allclose(scales, model.gaussians.scales[[4]] / (0.8 * 3))
    apart = (edit.replace["gaussians.means"] - model.gaussians.means[4]).norm(dim=1)
    assert (apart > 0).all() and (apart < 0.6).all()


def test_faint_ones_are_pruned_down_to_the_floor(model):
    with torch.no_grad():
        model.gaussians.opacity_logits.copy_(torch.linspace(-30, -20, 10))
    edit = with_gradient(Densify(min_gaussians=3), []).plan(model, draws())
    assert edit.keep.tolist() == [False] * 7 + [True] * 3  # the most opaque stay


def test_wide_ones_are_pruned_when_asked(model):
    densify = with_gradient(Densify(max_radius=50.0, min_gaussians=1), [])
    densify.statistics["radius"][3] = 51.0
    assert densify.plan(model, draws()).keep.tolist() == [i != 3 for i in range(10)]


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_never_more_than_allowed_and_the_neediest_first(model, share):
    densify = with_gradient(
        Densify(grad_threshold=0.5, size_share=share, max_gaussians=14), range(10)
    )
    densify.statistics["gradient"] = torch.arange(10.0) + 1
    edit = densify.plan(model, draws())
    assert int(edit.keep.sum()) + len(edit.parents) == 14
    assert set(edit.parents.tolist()) == {6, 7, 8, 9}


def rendering(model, rendered, share=1.0):
    batch = SimpleNamespace(share=share, rx=SimpleNamespace(batched=True))
    return SimpleNamespace(
        model=model, total_steps=100, rendered=rendered, batch=batch, global_step=0
    )


def statistics(model, gradient, visible=True, shares=(1.0,)) -> dict[str, torch.Tensor]:
    """What is gathered from gradients (B, 10, 2),
    once for each share that a process has of the batch.
    """
    seen = torch.full(gradient.shape[:2], visible)
    raster = SimpleNamespace(means2d=SimpleNamespace(grad=gradient), visible=seen, radii=2.0 * seen)
    densify = Densify()
    for share in shares:
        module = rendering(model, Rendered(torch.zeros(1), raster), share)
        densify.on_after_backward(SimpleNamespace(), module)
    return densify.statistics


def test_gradients_are_read_per_sample_before_summing(model):
    """Two samples that pull apart: their sum is zero, their need is not."""
    shift = torch.zeros(2, 10, 2)
    shift[0, 5, 0], shift[1, 5, 0] = 3.0, -3.0
    found = statistics(model, shift, shares=(1.0, 1.0))
    assert found["gradient"][5] == 12 and found["seen"][5] == 4


def test_who_was_not_seen_asks_for_nothing(model):
    found = statistics(model, torch.ones(1, 10, 2), visible=False)
    assert not found["gradient"].any() and not found["radius"].any()


def test_rows_of_another_process_are_not_counted_twice(model):
    assert statistics(model, torch.ones(1, 10, 2), shares=(1.0, 0.0))["seen"].tolist() == [1] * 10


def test_edits_happen_on_the_schedule_only(model):
    trainer = SimpleNamespace(optimizers=[optimizer_for(model, OptimizerSettings())], loggers=[])
    edited = []
    for step in range(0, 60, 5):
        densify = with_gradient(
            Densify(start=20, stop=40, interval=10, grad_threshold=0.5), [0], len(model.gaussians)
        )
        before = int(model.gaussians.version)
        densify.on_train_batch_start(trainer, at(model, step, 100))
        edited += [step] if int(model.gaussians.version) > before else []
    assert edited == [20, 30, 40]


def test_a_moving_receiver_gives_gradients_per_pose(campaign):
    data = campaign("spectrum", static_end="tx")
    settings = ModelSettings(field=FieldSettings(count=30, placement="uniform"), emission=EMISSION)
    moving = GaussianModel(settings, data.site, None, torch.zeros(3))
    batch = data.batch([0, 1, 2, 3])
    rendered = moving(batch.tx, batch.rx)
    rendered.mean.sum().backward()
    densify = Densify()
    densify.on_after_backward(SimpleNamespace(), rendering(moving, rendered))
    assert rendered.raster.means2d.grad.shape == (4, 30, 2)
    assert densify.statistics["seen"].max() > 1 and densify.statistics["gradient"].any()


def test_children_lie_as_their_parent_does():
    scales = torch.tensor([[2.0, 0.1, 0.1]]).expand(20_000, 3)
    half = 0.5**0.5
    quats = torch.tensor([[half, 0.0, 0.0, half]]).expand(20_000, 4)  # x becomes y
    spread = _sample_inside(scales, quats, draws()).std(0)
    assert torch.allclose(spread, torch.tensor([0.1, 2.0, 0.1]), rtol=0.03)


def test_large_ones_go_by_size_and_by_radius_from_a_step_on(model):
    with torch.no_grad():
        model.gaussians.log_scales[3] = 3.0
    densify = with_gradient(Densify(max_size_share=0.1, max_radius=5.0, min_gaussians=0), [])
    densify.statistics["radius"][4] = 6.0
    assert (~densify.plan(model, draws()).keep).nonzero().flatten().tolist() == [3, 4]
    assert (~densify.plan(model, draws(), by_radius=False).keep).nonzero().flatten().tolist() == [3]


def test_centres_are_held_near_the_scene(model):
    with torch.no_grad():
        model.gaussians.means[2] = 100.0
    Bounds(margin=1.0).on_train_batch_end(None, at(model, 1, 10))
    high = torch.as_tensor(model.site.box[1]).float() + 1
    torch.testing.assert_close(model.gaussians.means[2].detach(), high)
    assert int(model.gaussians.version) == 1
