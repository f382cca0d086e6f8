"""Surgery: clone, split, prune and reset desynchronise parameters, moments and counters.

Remedy: one place edits them all (gsparc/field/edit.py). Shown: after any sequence shapes agree,
moments are finite, untouched rows are bit-identical in everything, ids are permanent and unique.
Tolerance: none.
"""

import math
from types import SimpleNamespace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from invented import invent

from gsparc.callbacks import Densify, OpacityReset
from gsparc.field.edit import row_parameters
from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import GaussianModel, ModelSettings
from gsparc.field.optimizer import OptimizerSettings, optimizer_for
from gsparc.ops import Pose

SITE = invent("spectrum").site
RECEIVER = Pose.identity(torch.tensor([0.0, 0.0, -2.0]))


def fresh(count: int) -> tuple[GaussianModel, SimpleNamespace]:
    torch.manual_seed(0)
    emission = EmissionSettings(
        EncodingSettings("raw"), hidden=2, activation="sigmoid", init_bias=0.0
    )
    model = GaussianModel(
        ModelSettings(FieldSettings(count=count, placement="sphere"), emission), SITE, RECEIVER
    )
    optimizer = optimizer_for(model, OptimizerSettings())
    return model, SimpleNamespace(optimizers=[optimizer], global_step=0, loggers=[])


def learn(model: GaussianModel, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    model(torch.rand(2, 3), RECEIVER).mean.square().sum().backward()
    optimizer.step()


def rows_by_id(
    model: GaussianModel, optimizer: torch.optim.Optimizer
) -> dict[int, list[torch.Tensor]]:
    """Everything that belongs to each Gaussian, by its permanent id."""
    found: dict[int, list[torch.Tensor]] = {int(i): [] for i in model.gaussians.ids}
    for parameter in row_parameters(model, len(model.gaussians)).values():
        moments = [optimizer.state[parameter][key] for key in ("exp_avg", "exp_avg_sq")]
        for row, name in enumerate(found):
            found[name] += [parameter[row].detach().clone(), *(m[row].clone() for m in moments)]
    return found


EDIT = st.fixed_dictionaries(
    {
        "want": st.floats(0, 1),
        "share": st.sampled_from([0.0, 0.3, 1e9]),  # all split, some, all cloned
        "prune": st.sampled_from([0.0, 0.2, 0.9]),
        "most": st.integers(1, 40),
        "children": st.integers(2, 3),
        "reset": st.booleans(),
    }
)


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 12), edits=st.lists(EDIT, min_size=1, max_size=5), seed=st.integers(0, 99)
)
def test_any_sequence_leaves_one_consistent_state(count, edits, seed):
    model, trainer = fresh(count)
    optimizer = trainer.optimizers[0]
    module = SimpleNamespace(model=model, total_steps=99, global_step=0, solved=False)
    draw = torch.Generator().manual_seed(seed)
    ever = set(model.gaussians.ids.tolist())
    for number, edit in enumerate(edits, start=1):
        learn(model, optimizer)
        n = len(model.gaussians)
        with torch.no_grad():
            weak = torch.rand(n, generator=draw) < edit["prune"]
            model.gaussians.opacity_logits[weak] = -9.0
        before = rows_by_id(model, optimizer)
        densify = Densify(
            0,
            99,
            1,
            0.5,
            edit["share"],
            edit["children"],
            max_gaussians=edit["most"],
            min_gaussians=1,
        )
        wanting = (torch.rand(n, generator=draw) < edit["want"]).float()
        densify.statistics = {"gradient": wanting, "seen": torch.ones(n), "radius": torch.ones(n)}
        trainer.global_step = module.global_step = number
        densify.on_train_batch_start(trainer, module)

        ids = model.gaussians.ids.tolist()
        assert len(set(ids)) == len(ids) >= 1
        assert len(ids) <= max(edit["most"], n)
        new = set(ids) - set(before)
        assert not new & ever and all(i < int(model.gaussians.next_id) for i in ids)
        ever |= new
        after = rows_by_id(model, optimizer)
        for name in set(ids) & set(before):
            assert all(torch.equal(a, b) for a, b in zip(before[name], after[name], strict=True))
        for name in new:
            assert all(part.isfinite().all() for part in after[name])
        assert {len(t) for t in densify.statistics.values()} == {len(ids)}
        assert int(model.gaussians.version) >= number

        if edit["reset"]:
            before = rows_by_id(model, optimizer)
            OpacityReset(1, 99, 0.01, least_steps=0).on_train_batch_start(trainer, module)
            assert (model.gaussians.opacities <= 0.01 + 1e-6).all()
            after = rows_by_id(model, optimizer)
            opacity = list(row_parameters(model, len(ids))).index("gaussians.opacity_logits")
            for name in ids:
                for place, (a, b) in enumerate(zip(before[name], after[name], strict=True)):
                    assert place // 3 == opacity or torch.equal(a, b)
    learn(model, optimizer)
    assert all(p.isfinite().all() for p in model.parameters())


NASTY = st.sampled_from([0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, math.inf, -math.inf, math.nan])


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(count=st.integers(1, 12), draws=st.data())
def test_statistics_of_any_kind_leave_a_sound_field(count, draws):
    """Gradients that overflowed or are NaN decide who is split;
    what comes out is finite all the same.
    """
    model, trainer = fresh(count)
    learn(model, trainer.optimizers[0])
    nasty = {
        key: torch.tensor(draws.draw(st.lists(NASTY, min_size=count, max_size=count)))
        for key in ("gradient", "seen", "radius")
    }
    densify = Densify(
        0, 99, 1, 0.5, draws.draw(st.sampled_from([0.0, 1e9])), max_radius=5.0, max_gaussians=20
    )
    densify.statistics = nasty
    module = SimpleNamespace(model=model, total_steps=99, global_step=1, solved=False)
    densify.on_train_batch_start(trainer, module)
    assert 1 <= len(model.gaussians) <= 20
    assert all(p.isfinite().all() for p in model.parameters())
    assert all(t.isfinite().all() for t in densify.statistics.values())
    learn(model, trainer.optimizers[0])
    assert all(p.isfinite().all() for p in model.parameters())
