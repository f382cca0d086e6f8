"""What physics leaves over, learned as a process: where sources explain part of a channel, a kernel the rest.

Rough walls and clutter make many weak paths that no search finds, and that a Gaussian process knows as far as
receivers stand within half a wavelength of each other. It is taught what each receiver measured less what the
sources of all *other* receivers say, and counts by how well its own leave-one-out predictions do.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.coherent.complex_gp import ComplexGP
from gsparc.coherent.vsgp import VirtualSourceGP
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.effects import Decision, Switch
from gsparc.method import Method

LEAST_GAIN = 0.03  # of the left-out residual's power, below which `auto` does without


@dataclass(frozen=True)
class Rest:
    """A process of what physics leaves over.

    Attributes:
        process: taught the left-out residuals.
        weight: in (0, 1], that of least squared left-out error.
        gain: share of the left-out residual's power that it explains.
    """

    process: ComplexGP
    weight: float
    gain: float

    def at(self, places: Tensor) -> Tensor:
        """What it adds (B, A, K) complex64 at places (B, 3) [m]."""
        return self.weight * self.process.mean_at(places)

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs."""
        return {"process": self.process.state(), "weight": self.weight, "gain": self.gain}

    @staticmethod
    def restore(site: Site, state: dict[str, Any]) -> Rest:
        """The one whose `state()` this was."""
        process = ComplexGP()
        process.restore(site, state["process"])
        return Rest(process, float(state["weight"]), float(state["gain"]))


def learn_rest(switch: Switch, physics: Method, data: Measurements) -> tuple[Decision, Rest | None]:
    """Whether a process is to explain the rest, decided by leave-one-out, and the process.

    Args:
        switch: `auto`, true or false.
        physics: fitted on `data`.
        data: all measurements; only rows that physics holds are looked at.
    """
    started = time.perf_counter()
    obstacle = None
    if switch is False:
        obstacle = "as configured"
    elif not isinstance(physics, VirtualSourceGP):
        obstacle = "only sources with carrier phase tell what they leave over"
    elif data.target[0].size > 1 or physics.offsets != "none":
        obstacle = "it is for one channel per receiver whose phase is known"
    if obstacle is not None:
        return Decision("hybrid", False, obstacle), None
    assert isinstance(physics, VirtualSourceGP)
    receivers, left = physics.left_over()
    target = np.zeros_like(data.target)
    target[receivers] = left.numpy().reshape(-1, *data.target.shape[1:])
    process, none = ComplexGP(), receivers[:0]
    process.fit(replace(data, target=target), Fold(receivers, none, none), Path())
    weight, gain = _worth(process, left.flatten().to(torch.complex128))
    on = weight > 0 and (switch is True or gain >= LEAST_GAIN)
    reason = f"a process explains {max(gain, 0):.0%} of what the sources leave over, left out one by one"
    spent = time.perf_counter() - started
    return Decision("hybrid", on, reason, spent), Rest(process, weight, gain) if on else None


def _worth(process: ComplexGP, residual: Tensor) -> tuple[float, float]:
    """The weight of least squared error of leave-one-out predictions of residuals (n,), and what it gains.

    Rasmussen and Williams (2006), eq. 5.12.
    """
    inverse = torch.cholesky_inverse(process.factor).diagonal()
    predicted = residual - process.weights[:, 0] / inverse
    overlap = float((predicted.conj() * residual).real.sum())
    weight = min(max(overlap / max(float(predicted.abs().square().sum()), 1e-30), 0.0), 1.0)
    error = (residual - weight * predicted).abs().square().sum()
    return weight, 1 - float(error / residual.abs().square().sum().clamp_min(1e-30))
