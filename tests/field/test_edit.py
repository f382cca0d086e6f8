import torch

from gsparc.field import edit
from gsparc.field.edit import Edit, resize_gaussians, row_parameters
from gsparc.field.gaussians import GaussianField


class Root(torch.nn.Module):
    """A field, a per-Gaussian head and something that belongs to nobody in particular."""

    def __init__(self, count: int = 6) -> None:
        super().__init__()
        self.gaussians = GaussianField(
            torch.arange(3.0 * count).reshape(count, 3), torch.ones(count, 3), 0.5
        )
        self.head = torch.nn.Module()
        self.head.per_gaussian = True
        self.head.weight = torch.nn.Parameter(torch.randn(count, 2, 3))
        # As many rows, but not the Gaussians'
        self.shared = torch.nn.Parameter(torch.randn(count, 3))


def stepped(root: Root) -> torch.optim.Adam:
    optimizer = torch.optim.Adam([{"params": [p]} for p in root.parameters()], fused=True)
    sum(p.square().sum() for p in root.parameters()).backward()
    optimizer.step()
    return optimizer


def test_one_edit_moves_everything_together():
    root = Root()
    optimizer = stepped(root)
    rows = {name: p.detach().clone() for name, p in row_parameters(root, 6).items()}
    moments = {id(p): optimizer.state[p]["exp_avg"].clone() for p in root.parameters()}
    old = {name: moments[id(p)] for name, p in row_parameters(root, 6).items()}
    shared = root.shared
    keep = torch.tensor([True, False, True, True, False, True])
    replace = {"gaussians.means": torch.full((2, 3), 9.0)}
    edit.apply_edit(Edit(keep, torch.tensor([1, 3]), replace), root, root.gaussians, optimizer)
    for name, parameter in row_parameters(root, 6).items():
        assert torch.equal(parameter[:4], rows[name][keep])
        wanted = replace.get(name, rows[name][[1, 3]])
        assert torch.equal(parameter[4:], wanted)
        state = optimizer.state[parameter]
        assert torch.equal(state["exp_avg"][:4], old[name][keep]) and not state["exp_avg"][4:].any()
        assert state["exp_avg_sq"].shape == parameter.shape and not state["exp_avg_sq"][4:].any()
    assert root.gaussians.ids.tolist() == [0, 2, 3, 5, 6, 7] and int(root.gaussians.next_id) == 8
    assert int(root.gaussians.version) == 1 and root.shared is shared
    held = {id(group["params"][0]) for group in optimizer.param_groups}
    assert held == {id(p) for p in root.parameters()} and len(optimizer.state) == len(held)


def test_resize_makes_room_for_a_state_dict():
    larger, smaller = Root(9), Root(4)
    smaller.shared = torch.nn.Parameter(torch.zeros(9, 3))
    resize_gaussians(smaller, smaller.gaussians, 9)
    smaller.load_state_dict(larger.state_dict())
    assert (
        torch.equal(smaller.gaussians.means, larger.gaussians.means) and len(smaller.gaussians) == 9
    )


def test_what_is_not_learned_is_not_learned_after_an_edit_either():
    """The delays of a single tone began to ask for gradients, without a group of the optimizer."""
    root = Root()
    root.head.weight.requires_grad_(False)
    edit.apply_edit(Edit(torch.ones(6, dtype=torch.bool), torch.tensor([1])), root, root.gaussians)
    assert len(root.head.weight) == 7 and not root.head.weight.requires_grad
    resize_gaussians(root, root.gaussians, 3)
    assert not root.head.weight.requires_grad and root.gaussians.means.requires_grad
