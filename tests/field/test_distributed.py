"""Several processes train what one does; one that is killed ends all,
and the run goes on bit for bit.
"""

import shutil

import pytest
import torch
from invented import invent
from several import Kill, trained
from states import same

from gsparc.field.distributed import (
    SummedGradients,
)


def test_strategies_that_share_batches_are_known_by_name():
    assert SummedGradients.from_strategy("ddp")._start_method == "spawn"
    assert (
        SummedGradients.from_strategy("ddp_fork_find_unused_parameters_true")._start_method
        == "fork"
    )
    assert (
        SummedGradients.from_strategy("auto")
        is SummedGradients.from_strategy("fsdp")
        is SummedGradients.from_strategy(object())
        is None
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("static_end", "double", "most"),
    [("rx", True, 1e-12), ("rx", False, 1e-3), ("tx", True, 1e-12)],
)
def test_two_processes_learn_what_one_does(tmp_path, static_end, double, most):
    """200 steps with densification, pruning and resets; every 10 steps both hold the same bits."""
    data = invent("spectrum", 40, static_end)
    one = trained(data, tmp_path / "one", 1, double=double).state_dict()
    two = trained(data, tmp_path / "two", 2, double=double).state_dict()
    assert one["model.gaussians.next_id"] > 60 and one["model.gaussians.version"] > 5
    assert torch.equal(one["model.gaussians.ids"], two["model.gaussians.ids"])
    for name, value in one.items():
        assert (value - two[name]).abs().max() <= most * (1 + value.abs().max()), name


@pytest.mark.slow
def test_a_killed_process_ends_all_and_the_run_goes_on_bit_identically(tmp_path):
    data, cut = invent("spectrum", 40), tmp_path / "cut"
    trained(data, tmp_path / "whole", 2, 63)
    last = cut / "last.ckpt"
    with pytest.raises(
        RuntimeError, match=f"process 1 ended by SIGKILL.*ckpt_path={last}"
    ) as error:
        trained(data, cut, 2, 63, more=[Kill(33)])
    assert "\n" not in str(error.value)
    left = torch.load(last, weights_only=True)
    assert left["global_step"] == 28
    shutil.copy(last, tmp_path / "cut.ckpt")
    trained(data, cut, 2, 63, resume=last)
    whole, resumed = (
        torch.load(f / "last.ckpt", weights_only=True) for f in (tmp_path / "whole", cut)
    )
    assert whole["global_step"] == 63 and len(whole["state_dict"]["model.gaussians.ids"]) > 20
    for part in ("state_dict", "optimizer_states", "lr_schedulers"):
        assert same(whole[part], resumed[part]), part
    assert same(whole["callbacks"]["Densify"], resumed["callbacks"]["Densify"])
    alone = trained(data, tmp_path / "alone", 1, 63, resume=tmp_path / "cut.ckpt").state_dict()
    for name, value in whole["state_dict"].items():  # with another number of processes
        assert (value - alone[name]).abs().max() <= 1e-12 * (1 + value.abs().max()), name
