"""Peers trained by gradient: what a network knows of a scene, training under a time budget, stored state."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import lightning.pytorch as L
import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.datamodule import order
from gsparc.data.query import Batch, Query
from gsparc.data.schema import Kind, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.models.method import Method, Prediction
from gsparc.ops import Pose
from gsparc.training.context import FitContext, FitReport
from gsparc.training.losses import channel_loss, spectrum_loss
from gsparc.training.time_budget import TimeBudget

DEFAULT_BUDGET_S = 60.0
FINAL_RATE = 0.02  # share of the initial learning rate that is left at the end
SLACK = 3.0  # times the seconds that are wanted, after which a schedule of a table's steps is cut
WARMUP = 0.02  # share of the training over which rates rise
QUERY_CHUNK = 32  # bounds the memory of one prediction call


@dataclass(frozen=True)
class Scene:
    """What a network may know of a site before it is trained.

    Attributes:
        site: the fixed facts.
        shape: of one target: (H, W), (antennas, subcarriers) or (1,).
        receiver: pose of the static receiver; None when it moves.
        transmitter: (3,) [m], the static transmitter; None when it moves.
        box: (2, 3) float32 [m], lower and upper corner of the moving end's training positions.
    """

    site: Site
    shape: tuple[int, ...]
    receiver: Pose | None
    transmitter: Tensor | None
    box: Tensor

    @property
    def reach(self) -> float:
        """Extent of the scene [m]: from the static end to the far side of the box."""
        low, high = self.box
        still = self.receiver.position if self.receiver is not None else self.transmitter
        middle = (low + high) / 2
        apart = 0.0 if still is None else float((still - middle).norm())
        return max(apart + float((high - low).norm()) / 2, 1.0)


class Network(nn.Module):
    """Positions in, targets out: called with tx (B, 3) [m] and one shared or B receiver poses.

    Args:
        scene: what is known of the site.
        count: Gaussians, or virtual transmitters.
    """

    ssim_weight = 0.2  # share of the loss of spectra

    def __init__(self, scene: Scene, count: int = 0) -> None:
        super().__init__()
        self.scene, self.count = scene, count

    def loss(self, batch: Batch, draw: torch.Generator) -> Tensor:
        """Training loss () of a batch; `draw` for whatever is drawn at random."""
        prediction = self(batch.tx, batch.rx)
        if prediction.is_complex():
            return channel_loss(prediction, batch.target, batch.mask).mean()
        if batch.mask is not None:
            prediction = torch.where(batch.mask, prediction, batch.target)
        return spectrum_loss(prediction, batch.target, self.ssim_weight).mean()

    @torch.no_grad()
    def rendered(self, tx: Tensor, rx: Pose) -> Tensor:
        """The prediction at inference, which may keep state between calls."""
        return self(tx, rx)


def perceptron(
    inner: int, outer: int, width: int, depth: int, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """`depth` hidden layers of `width`."""
    sizes = [inner, *[width] * depth]
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), activation())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outer))


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

    def build(self, scene: Scene, precomputed: dict[str, Tensor]) -> Network:
        """The untrained network of a scene; `precomputed` is what was computed before training."""
        network: Network = self.makes(scene, self)
        return network

    def precompute(self, data: Measurements, rows: np.ndarray) -> dict[str, Tensor]:
        """Tensors computed from the training rows (n,) before training; stored with the weights."""
        return {}

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Train to the end of the schedule, or of the seconds.

        Raises:
            ValueError: a kind of data the method does not serve, or no training rows.
            RuntimeError: the loss became NaN or infinite.
        """
        assert self.budget_s is not None
        limit = self.budget_s if self.max_steps else SLACK * self.budget_s
        budget, kinds = TimeBudget(limit, "processor"), tuple(self.step_s)
        rows = np.sort(np.concatenate([fold.train, fold.val]))
        if data.site.kind not in kinds:
            raise ValueError(
                f"{self.name}: predicts {' and '.join(kinds)}; this dataset holds {data.site.kind}"
            )
        if not len(rows):
            raise ValueError(f"{self.name}: the training set is empty")
        L.seed_everything(self.seed, verbose=False)
        self.site, self.precomputed = data.site, self.precompute(data, rows)
        self.network = self.build(_scene(data, rows), self.precomputed)
        self._train(data, rows, budget)
        self.network.eval()
        note = f"{self.name}: {self.steps} steps of {min(self.batch_size, len(rows))} samples"
        return FitReport(budget.counted.wall, (note,), budget.limited_by)

    def _train(self, data: Measurements, rows: np.ndarray, budget: TimeBudget) -> None:
        network = self.fitted()
        optimizer = torch.optim.Adam(self._groups(network), eps=1e-15)
        base = [group["lr"] for group in optimizer.param_groups]
        draw = torch.Generator().manual_seed(self.seed)
        total = self.max_steps or self._steps_within(data.site.kind)
        for step in range(total):
            if step and budget.over():
                break
            for group, rate in zip(optimizer.param_groups, base, strict=True):
                group["lr"] = rate * rate_factor(step / total)
            batch = data.batch(order(self.seed, step, self.batch_size, rows))
            optimizer.zero_grad(set_to_none=True)
            loss = network.loss(batch, draw)
            if not torch.isfinite(loss):
                raise RuntimeError(
                    f"{self.name}: the loss became NaN or infinite at step {step}; lower model.rate"
                )
            loss.backward()
            optimizer.step()
            self.steps = step + 1

    def _steps_within(self, kind: Kind) -> int:
        """Steps that the seconds hold by `step_s`; of other batches in proportion."""
        assert self.budget_s is not None
        return max(round(self.budget_s / self.step_s[kind] * type(self).batch_size / self.batch_size), 1)

    def _groups(self, network: nn.Module) -> Iterator[dict[str, Any]]:
        for name, parameter in network.named_parameters():
            known = [prefix for prefix in self.rates if name.startswith(prefix)]
            rate = self.rates[max(known, key=len)] if known else self.rate
            yield {"params": [parameter], "lr": rate}

    def fitted(self) -> Network:
        """The network; `ValueError` before `fit` or `restore`."""
        if self.network is None:
            raise ValueError(f"{self.name}: not fitted yet; call fit or restore first")
        return self.network

    def size(self) -> int:
        """Number of Gaussians or virtual transmitters; 0 for a network without, and before `fit`."""
        return 0 if self.network is None else self.network.count

    def gradient_problem(self) -> str | None:
        """See `Method.gradient_problem`."""
        return "its network answers in float32 and keeps no graph"

    @torch.no_grad()
    def predict(self, query: Query) -> Prediction:
        """See `Method.predict`; these peers give no confidence."""
        network = self.fitted()
        mean = torch.cat([network.rendered(part.tx, part.rx) for part in query.split(QUERY_CHUNK)])
        return Prediction(mean if mean.is_complex() else mean.clamp(0, 1))

    def state(self) -> dict[str, Any]:
        """Weights, and what the network is built from."""
        network = self.fitted()
        scene, receiver = network.scene, network.scene.receiver
        return {
            "shape": list(scene.shape),
            "receiver": None if receiver is None else [receiver.position, receiver.rotation],
            **{"transmitter": scene.transmitter, "box": scene.box, "found": self.precomputed},
            **{"network": network.state_dict(), "steps": self.steps},
        }

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        receiver = None if state["receiver"] is None else Pose(*state["receiver"])
        self.site = site
        scene = Scene(site, tuple(state["shape"]), receiver, state["transmitter"], state["box"])
        self.precomputed, self.steps = dict(state["found"]), int(state["steps"])
        self.network = self.build(scene, self.precomputed)
        self.network.load_state_dict(state["network"])
        self.network.eval()


def rate_factor(progress: float) -> float:
    """Learning rate at a share of the training in [0, 1], relative to the largest: a rise, then a cosine."""
    rise = min((progress + 1e-3) / WARMUP, 1.0)
    return rise * (FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))


def _scene(data: Measurements, rows: np.ndarray) -> Scene:
    one, moving = data.batch(rows[:1]), data.moving[rows]
    box = torch.from_numpy(np.stack([moving.min(0), moving.max(0)])).float()
    static = data.site.static_end == "rx"
    ends = (one.rx, None) if static else (None, one.tx[0])
    return Scene(data.site, tuple(data.target.shape[1:]), *ends, box)  # type: ignore[call-arg]
