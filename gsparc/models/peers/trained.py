"""Peers trained by gradient: what a network knows of a scene, counted steps, stored state."""

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
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.data.target import Kind
from gsparc.field.losses import LossSettings, task_loss
from gsparc.field.module import NetworkModule
from gsparc.field.optimizer import OptimizerSettings
from gsparc.models.checkpoint import read_interrupted
from gsparc.models.fitting import Origin
from gsparc.models.gradient import train_module
from gsparc.models.method import Method, Prediction
from gsparc.ops import Pose
from gsparc.training.context import FitContext, FitReport
from gsparc.training.effort import Effort
from gsparc.training.stopwatch import Stopwatch

FINAL_RATE = 0.02  # share of the initial learning rate that is left at the end
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
        distance = (
            0.0 if still is None else float((torch.from_numpy(still) - (low + high) / 2).norm())
        )
        return max(distance + float((high - low).norm()) / 2, 1.0)


class Network(nn.Module):
    """Queries in, targets out.

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
        return task_loss(self(batch), batch, self.losses, self.scene.site.target).mean()

    @torch.no_grad()
    def rendered(self, query: Query) -> Tensor:
        """Return the prediction at inference, which may keep state between calls."""
        return self(query)


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
    """Learns from `fold.train` and `fold.val` together in counted steps;
    nothing is chosen on `val`.

    Args:
        learn_val: false: validation rows are not learned from, but watched, and their figures
            logged.
        max_steps: of the learning-rate schedule. None takes `usual_steps`, times the effort.
        batch_size: samples per step.
        rate: Adam's learning rate where `rates` names no other.
        seed: of initial weights and order of the samples.
        name: as it appears in tables.
    """

    no_gradient = "its network answers in float32 and keeps no graph"
    resumable: ClassVar[bool] = True  # type: ignore[misc]
    takes_effort: ClassVar[bool] = True  # type: ignore[misc]
    threads_pay: ClassVar[bool] = True  # type: ignore[misc]
    is_yardstick: ClassVar[bool] = True  # type: ignore[misc]
    # A minute of one core at its usual batches (docs/table.md)
    usual_steps: ClassVar[dict[Kind, int]]
    makes: ClassVar[type[Any]]  # a `Network` of a scene and these settings
    rates: ClassVar[dict[str, float]] = {}  # by the beginning of a parameter's name
    name: str
    learn_val: bool = True
    max_steps: int | None = None
    batch_size: int = 8
    rate: float = 2e-3
    seed: int = 0
    network: Network | None = field(default=None, init=False, repr=False)
    precomputed: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)
    steps: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ValueError(f"{self.name}: batch_size >= 1 is needed, got {self.batch_size}")

    def _count_steps(self, kind: Kind, effort: Effort, asked: int | None) -> int:
        """Steps that are asked for, else of as many samples as usual, times the effort."""
        if asked is not None:
            return asked
        steps = effort.factor * self.usual_steps[kind] * type(self).batch_size / self.batch_size
        return max(round(steps), 1)

    def describe_fit(self, data: Measurements, effort: Effort, steps: int | None = None) -> str:
        """See `MethodFactory`."""
        step_count, kind = self.max_steps if steps is None else steps, data.site.kind
        if step_count is None and kind not in self.usual_steps:
            return ""  # `fit` says why
        return f"{self._count_steps(kind, effort, step_count)} steps of {self.batch_size} samples"

    def precompute(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Return tensors computed from the training rows (n,) before training;
        stored with the weights.
        """
        return {}

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train to the end of the schedule; steps of the Trainer win over the model's.

        Raises:
            ValueError: a kind of data the method does not serve, no rows, or a run of others to
                resume.
            RuntimeError: the loss became NaN or infinite.
        """
        kinds, kind = tuple(self.usual_steps), data.site.kind
        split = (
            replace(fold, train=np.r_[fold.train, fold.val], val=fold.val[:0])
            if self.learn_val
            else fold
        )
        rows = np.sort(split.train)
        if kind not in kinds:
            raise ValueError(
                f"{self.name}: predicts {' and '.join(kinds)}; this dataset holds {kind}"
            )
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        origin = Origin.from_fit(data, fold, context)
        context = replace(context, seed=self.seed, batch_size=self.batch_size, datamodule=None)
        step_count = context.requested_steps(len(rows), self.max_steps)
        watch = Stopwatch()
        L.seed_everything(self.seed, verbose=False)
        self.site, self.precomputed = data.site, self.precompute(data, rows)
        self.network = self.makes(_make_scene(data, rows), self)
        if context.resume is not None:
            origin.require_same(read_interrupted(context.resume))
        module = self.module(self._count_steps(kind, context.counts, step_count), context.run_dir)
        result = train_module(
            self, module, data, replace(split, train=rows), context, watch, origin.to_extra()
        )
        self.steps = result.taken
        self.network.eval()
        note = f"{self.name}: {self.steps} steps of {min(self.batch_size, len(rows))} samples"
        return FitReport(watch.seconds, (note, *result.notes), cpu_s=watch.cpu_elsewhere)

    def module(self, steps: int = 1, run_dir: Path = Path()) -> NetworkModule:
        """Return what Lightning trains, with a schedule of `steps`."""
        network, warmup = self.fitted(), max(round(WARMUP * steps), 1)
        rates = OptimizerSettings(decay=FINAL_RATE, warmup=warmup)
        return NetworkModule(network, network.scene.site, rates, steps, run_dir, self._rate_group)

    def _rate_group(self, name: str) -> tuple[str, float]:
        kind = max(
            (prefix for prefix in self.rates if name.startswith(prefix)), key=len, default="other"
        )
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
        mean = torch.cat([network.rendered(part) for part in query.split(QUERY_CHUNK)])
        return Prediction(mean if mean.is_complex() else mean.clamp(0, 1))

    def state(self) -> dict[str, Any]:
        """Return weights, and what the network is built from."""
        network = self.fitted()
        scene = {
            "shape": list(network.scene.shape),
            "box": network.scene.box,
            "found": self.precomputed,
        }
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
