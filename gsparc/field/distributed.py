"""Training shared by processes: each takes its rows of every batch, and all hold the same model.

Gradients are summed here, not by DistributedDataParallel: its reducer knows the parameters it began
with, and adding or removing Gaussians replaces them.
One buffer a step is enough for models of this size.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal

import lightning.pytorch as L
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, distributed
from torch.distributed import ReduceOp

GRACE_S = 2.0  # a process that lost another waits for that one's error to be the one that is said


class SummedGradients(DDPStrategy):
    """Processes of this machine, and of others where `trainer.num_nodes` says so,
    that end with training.

    A loss is to be the process's part of the mean over the whole batch (`Batch.share`): gradients
    are added up, and equal those of one process but for rounding.

    Args:
        start_method: `spawn`, or `fork`, which is quicker and may hang where other threads run.
    """

    def __init__(self, start_method: Literal["spawn", "fork"] = "spawn") -> None:
        # Named, because a Slurm job's environment would be taken for one process per task.
        super().__init__(cluster_environment=LightningEnvironment(), start_method=start_method)
        self.threads = torch.get_num_threads()
        self._accumulating = False

    @classmethod
    def from_strategy(cls, strategy: object) -> SummedGradients | None:
        """Return the one that `trainer.strategy` means: of `ddp*`; None of others."""
        if not (isinstance(strategy, str) and strategy.startswith("ddp")):
            return None
        return cls("fork" if "fork" in strategy or "notebook" in strategy else "spawn")

    def setup_environment(self) -> None:
        """Join the others, with a fair part of the threads."""
        for talkative in ("lightning.fabric", "lightning.pytorch"):  # who has joined whom
            logging.getLogger(talkative).setLevel(logging.WARNING)
        super().setup_environment()
        torch.set_num_threads(max(1, self.threads // self.num_processes))

    def configure_ddp(self) -> None:
        """Wrap nothing; all begin with the first process's numbers."""
        assert self.lightning_module is not None
        for tensor in self.lightning_module.state_dict().values():
            distributed.broadcast(tensor, 0)

    @contextmanager
    def block_backward_sync(self) -> Iterator[None]:
        """Hold sums back while gradients of several batches are added up for one step."""
        self._accumulating = True
        try:
            yield
        finally:
            self._accumulating = False

    def post_backward(self, closure_loss: Tensor) -> None:
        """Sum gradients, before they are unscaled, clipped and used."""
        if not self._accumulating:
            assert self.lightning_module is not None
            sum_gradients(p for p in self.lightning_module.parameters() if p.requires_grad)


@torch.no_grad()
def sum_gradients(parameters: Iterable[Tensor]) -> None:
    """Replace every gradient by its sum over processes; one that no process has stays None."""
    trained = list(parameters)
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in trained]
    # Sent along: a parameter without a gradient in this process may have one in another.
    has = gradients[0].new_tensor([p.grad is not None for p in trained])
    flat = process_sum(torch.cat([has, *(gradient.flatten() for gradient in gradients)]))
    sums = flat[len(trained) :].split([gradient.numel() for gradient in gradients])
    for parameter, somewhere, result in zip(
        trained, flat[: len(trained)].tolist(), sums, strict=True
    ):
        parameter.grad = result.view_as(parameter).to(parameter.dtype) if somewhere else None


def process_count() -> int:
    """Return how many processes train."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def process_sum(values: Tensor) -> Tensor:
    """Sum over processes, in place; the values themselves where there is one."""
    return _all_reduce(values, ReduceOp.SUM)


def process_max(values: Tensor) -> Tensor:
    """Return the maximum over processes, in place; the values themselves where there is one."""
    return _all_reduce(values, ReduceOp.MAX)


def first_process_value(value: float, trainer: L.Trainer) -> float:
    """Return the first process's value: clocks differ, and all must decide alike."""
    if not distributed.is_initialized():
        return value
    shared = torch.tensor(value, dtype=torch.float64, device=trainer.strategy.root_device)
    with _raise_after_grace():
        distributed.broadcast(shared, 0)
    return float(shared)


def _all_reduce(values: Tensor, operation: ReduceOp.RedOpType) -> Tensor:
    if distributed.is_initialized():
        with _raise_after_grace():
            distributed.all_reduce(values, operation)
    return values


@contextmanager
def _raise_after_grace() -> Iterator[None]:
    try:
        yield
    except RuntimeError:
        time.sleep(GRACE_S)
        raise
