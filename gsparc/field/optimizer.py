"""Learning rates: one per kind of parameter, each a pure function of the step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LambdaLR

from gsparc.base.limits import Checked, internal, number, setting, whole

RateOf = Callable[[str], tuple[str, float]]

RATE = number(0)
WARMUP = 0.1  # of the steps after a start in closed form


@dataclass(frozen=True)
class OptimizerSettings(Checked):
    """Adam's rates (paper, table of hyperparameters) and their decay.

    Attributes:
        positions, positions_final: rate of the means [m per step], exponentially annealed.
        scales, rotations, opacities, emission, confidence, gain: initial rates.
        decay: final rate of everything but the positions, as a share of the initial one (cosine).
        warmup: steps over which all rates rise linearly from zero.
        solved_share: of all rates after a start in closed form: at the whole rates the first two
            steps cost 7 dB there.
        eps: Adam's epsilon.
    """

    positions: float = setting(1e-3, RATE)
    positions_final: float = setting(1e-5, RATE)
    scales: float = setting(0.005, RATE)
    rotations: float = setting(0.001, RATE)
    opacities: float = setting(0.0055, RATE)
    emission: float = setting(0.005, RATE)
    confidence: float = setting(0.005, RATE)
    gain: float = setting(0.005, RATE)
    decay: float = setting(0.05, RATE)
    warmup: int = setting(0, whole(0))
    solved_share: float = setting(0.01, RATE)
    # As in 3D Gaussian splatting: gradients of single Gaussians are below Adam's usual 1e-8.
    eps: float = internal(1e-15)

    def after_closed_form(self, total: int) -> OptimizerSettings:
        """Return the rates of `total` steps after a start in closed form: a share of these,
        from zero.
        """
        shares = {
            name: self.solved_share * getattr(self, name)
            for name in (*KINDS.values(), "positions_final")
        }
        return replace(self, **shares, warmup=max(self.warmup, round(WARMUP * total)))

    def rate_of(self, name: str) -> tuple[str, float]:
        """Return a parameter's kind and initial rate by dotted name;
        `KeyError` where none is declared.
        """
        kind = rate_kind(name)
        return kind, getattr(self, kind)


KINDS = {
    "gaussians.means": "positions",
    "gaussians.log_scales": "scales",
    "gaussians.quats": "rotations",
    "gaussians.opacity_logits": "opacities",
    "emission": "emission",
    "response": "emission",
    "confidence": "confidence",
    "log_gain": "gain",
}


def rate_kind(name: str) -> str:
    """Return which rate a parameter follows, by dotted name; `KeyError` where none is declared."""
    for prefix, kind in KINDS.items():
        if name == prefix or name.startswith(prefix + "."):
            return kind
    raise KeyError(
        f"no learning rate is declared for parameter {name!r}: add it to "
        "gsparc.field.optimizer.KINDS"
    )


def optimizer_for(
    model: nn.Module, settings: OptimizerSettings, rate_of: RateOf | None = None
) -> Adam:
    """Return Adam with one parameter tensor per group, so that surgery can exchange single tensors.

    Args:
        model: what is trained.
        settings: rates by kind of parameter, and epsilon.
        rate_of: gives another model's kinds of parameters, and their initial rates, by dotted name.
    """
    groups = []
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            kind, rate = (rate_of or settings.rate_of)(name)
            groups += [{"params": [parameter], "lr": rate, "name": name, "kind": kind}]
    return Adam(groups, eps=settings.eps, fused=True)


def rate_factor(kind: str, settings: OptimizerSettings, step: int, total: int) -> float:
    """Return the rate at `step` as a share of the initial one."""
    progress = min(step / max(total, 1), 1.0)
    # From one share, as a first step of rate 0 would be lost.
    rise = min((step + 1) / settings.warmup, 1.0) if settings.warmup else 1.0
    if kind == "positions":
        # Means that are held have no ratio of rates.
        if settings.positions == 0:
            return 0.0
        return rise * (settings.positions_final / settings.positions) ** progress
    return rise * (settings.decay + (1 - settings.decay) * 0.5 * (1 + math.cos(math.pi * progress)))


def scheduler_for(optimizer: Adam, settings: OptimizerSettings, total: int) -> LambdaLR:
    """Return the schedule of every group over `total` steps."""

    def factor(kind: str):
        return lambda step: rate_factor(kind, settings, step, total)

    return LambdaLR(optimizer, [factor(group["kind"]) for group in optimizer.param_groups])
