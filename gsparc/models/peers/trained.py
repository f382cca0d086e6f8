"""Peers trained by gradient: what a network knows of a scene, training under a time budget, stored state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import lightning.pytorch as L
import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.query import Batch, Query
from gsparc.data.schema import Kind, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.field.gradient_stage import interruptible, make_trainer, read_trainer_result, requested_steps
from gsparc.field.losses import LossSettings, task_loss
from gsparc.field.module import NetworkModule
from gsparc.field.optimizer import OptimizerSettings
from gsparc.models.fitting import Origin
from gsparc.models.method import Method, Prediction
from gsparc.models.splat.checkpoint_io import GsparcCheckpointIO, read_interrupted
from gsparc.ops import Pose
from gsparc.training.context import FitContext, FitReport
from gsparc.training.time_budget import TimeBudget, worst_clock

DEFAULT_BUDGET_S = 60.0
FINAL_RATE = 0.02  # share of the initial learning rate that is left at the end
SLACK = 3.0  # times the seconds that are wanted, after which a schedule of a table's steps is cut
WARMUP = 0.02  # share of the training over which rates rise
QUERY_CHUNK = 32  # bounds the memory of one prediction call
DIRECTIONS = torch.tensor([[-1.0], [1.0]]).repeat(1, 3)  # box (2, 3) of unit vectors
LEAST_POWER = 1e-8  # under the root of a magnitude, whose slope at zero is infinite


@dataclass(frozen=True)
class KnownSite:
    """What a network may know of a site before it is trained.

    Attributes:
        site: the fixed facts.
        shape: of one target: (H, W), (antennas, subcarriers) or (1,).
        box: (2, 3) float32 [m], lower and upper corner of the moving end's training positions.
    """

    site: Site
    shape: tuple[int, ...]
    box: Tensor

    @property
    def receiver(self) -> Pose | None:
        """Pose of the static receiver; None when it moves."""
        moves = self.site.static_end == "tx" or self.site.static_position is None
        return None if moves else Query.from_places(self.site, self.box).rx

    @property
    def reach(self) -> float:
        """Extent of the scene [m]: from the static end to the far side of the box."""
        still, (low, high) = self.site.static_position, self.box
        apart = 0.0 if still is None else float((torch.from_numpy(still) - (low + high) / 2).norm())
        return max(apart + float((high - low).norm()) / 2, 1.0)


class Network(nn.Module):
    """Positions in, targets out: called with tx (B, 3) [m] and one shared or B receiver poses.

    Args:
        scene: what is known of the site.
        count: Gaussians, or virtual transmitters.
    """

    losses = LossSettings()

    def __init__(self, scene: KnownSite, count: int = 0) -> None:
        super().__init__()
        self.scene, self.count = scene, count

    def loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """Return the training loss () of a batch; `generator` for whatever is drawn at random."""
        return task_loss(self(batch.tx, batch.rx), batch, self.losses).mean()

    @torch.no_grad()
    def rendered(self, tx: Tensor, rx: Pose) -> Tensor:
        """Return the prediction at inference, which may keep state between calls."""
        return self(tx, rx)


def perceptron(
    inner: int, outer: int, width: int, depth: int, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Return `depth` hidden layers of `width`."""
    sizes = [inner, *[width] * depth]
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), activation())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outer))


def smooth_root(power: Tensor) -> Tensor:
    """Return roots, with a slope that is finite at zero."""
    return (power + LEAST_POWER).sqrt()


@dataclass(eq=False, kw_only=True)
class TrainedPeer(Method):
    """Learns from `fold.train` and `fold.val` together in counted steps; nothing is chosen on `val`.

    Args:
        budget_s: seconds of training in processor time per thread. None takes 60.
        max_steps: of the learning-rate schedule, which the seconds cut. None takes as many as the seconds
            hold by `step_s`: a run repeats exactly unless its steps take `SLACK` times as long.
        batch_size: samples per step.
        rate: Adam's learning rate where `rates` names no other.
        seed: of initial weights and order of the samples.
        name: as it appears in tables.
    """

    no_gradient = "its network answers in float32 and keeps no graph"
    resumable: ClassVar[bool] = True  # type: ignore[misc]
    takes_budget: ClassVar[bool] = True  # type: ignore[misc]
    threads_pay: ClassVar[bool] = True  # type: ignore[misc]
    step_s: ClassVar[dict[Kind, float]]  # processor seconds of a step [s] (docs/results/compare)
    makes: ClassVar[type[Any]]  # a `Network` of a scene and these settings
    rates: ClassVar[dict[str, float]] = {}  # by the beginning of a parameter's name
    name: str
    budget_s: float | None = None
    max_steps: int | None = None
    batch_size: int = 8
    rate: float = 2e-3
    seed: int = 0
    network: Network | None = field(default=None, init=False, repr=False)
    precomputed: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)
    steps: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        budget_s = self.budget_s = DEFAULT_BUDGET_S if self.budget_s is None else self.budget_s
        if not budget_s > 0 or self.batch_size < 1:
            raise ValueError(
                f"{self.name}: budget_s > 0 and batch_size >= 1 are needed, got {budget_s}, {self.batch_size}"
            )

    def _steps_in_budget(self, kind: Kind) -> int:
        """As many as the seconds hold on the idle processor that `step_s` was measured on."""
        assert self.budget_s is not None
        own = self.budget_s / self.step_s[kind] * type(self).batch_size / self.batch_size
        return max(round(own), 1)

    def describe_time_limit(self, site: Site, budget_s: float | None) -> str:
        """See `MethodFactory.describe_time_limit`; steps stand for the seconds."""
        told = self.max_steps is None and site.kind in self.step_s
        steps = f"{self._steps_in_budget(site.kind)} steps, " if told else ""
        return f"{steps}about {self.budget_s:g} s of an idle processor"

    def precompute(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Return tensors computed from the training rows (n,) before training; stored with the weights."""
        return {}

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train to the end of the schedule, or of the seconds; steps of the Trainer win over the model's.

        Raises:
            ValueError: a kind of data the method does not serve, no rows, or a run of others to resume.
            RuntimeError: the loss became NaN or infinite.
        """
        assert self.budget_s is not None
        kinds, kind = tuple(self.step_s), data.site.kind
        rows = np.sort(np.concatenate([fold.train, fold.val]))
        if kind not in kinds:
            raise ValueError(f"{self.name}: predicts {' and '.join(kinds)}; this dataset holds {kind}")
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        origin = Origin.from_fit(data, fold, context)
        context = replace(context, seed=self.seed, batch_size=self.batch_size, datamodule=None)
        asked = requested_steps(context, len(rows), self.max_steps)
        budget = TimeBudget(self.budget_s * (SLACK if asked is None else 1), "processor")
        L.seed_everything(self.seed, verbose=False)
        self.site, self.precomputed = data.site, self.precompute(data, rows)
        self.network = self.makes(_make_scene(data, rows), self)
        if context.resume is not None:
            origin.require_same(read_interrupted(context.resume))
        module = self.module(self._steps_in_budget(kind) if asked is None else asked, context.run_dir)
        files = GsparcCheckpointIO(self, context.config_yaml, origin.to_extra())
        all_rows = Fold(rows, rows[:0], fold.test)
        trainer, batches = make_trainer(module, data, all_rows, context, files, budget)
        with interruptible(trainer, batches):
            trainer.fit(module, datamodule=batches, ckpt_path=context.resume, weights_only=True)
        result = read_trainer_result(trainer, budget)
        self.steps = result.taken
        self.network.eval()
        note = f"{self.name}: {self.steps} steps of {min(self.batch_size, len(rows))} samples"
        limited_by = worst_clock(budget.limited_by, "wall" if result.timed_out else None)
        return FitReport(budget.by_clock.wall, (note,), limited_by)

    def module(self, steps: int = 1, run_dir: Path = Path()) -> NetworkModule:
        """Return what Lightning trains, with a schedule of `steps`."""
        network, warmup = self.fitted(), max(round(WARMUP * steps), 1)
        rates = OptimizerSettings(decay=FINAL_RATE, warmup=warmup)
        return NetworkModule(network, network.scene.site, rates, steps, run_dir, self._rate_group)

    def _rate_group(self, name: str) -> tuple[str, float]:
        kind = max((known for known in self.rates if name.startswith(known)), key=len, default="other")
        return kind, self.rates.get(kind, self.rate)

    def fitted(self) -> Network:
        """Return the network; `ValueError` before `fit` or `restore`."""
        return self.require_fitted(self.network)

    def count_components(self) -> int:
        """Return the number of Gaussians or virtual transmitters; 0 without, and before `fit`."""
        return 0 if self.network is None else self.network.count

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; these peers give no confidence."""
        network = self.fitted()
        mean = torch.cat([network.rendered(part.tx, part.rx) for part in query.split(QUERY_CHUNK)])
        return Prediction(mean if mean.is_complex() else mean.clamp(0, 1))

    def state(self) -> dict[str, Any]:
        """Return weights, and what the network is built from."""
        network = self.fitted()
        scene = {"shape": list(network.scene.shape), "box": network.scene.box, "found": self.precomputed}
        return {**scene, "network": network.state_dict(), "steps": self.steps}

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        self.site, scene = site, KnownSite(site, tuple(state["shape"]), state["box"])
        self.precomputed, self.steps = dict(state["found"]), int(state["steps"])
        self.network = self.makes(scene, self)
        self.network.load_state_dict(state["network"])
        self.network.eval()


def _make_scene(data: Measurements, rows: np.ndarray) -> KnownSite:
    moving = data.moving[rows]
    box = torch.from_numpy(np.stack([moving.min(0), moving.max(0)])).float()
    return KnownSite(data.site, tuple(data.target.shape[1:]), box)
