"""Models that complete or average the predictions of another one, each weighted by left-out errors.

**ResidualGP.** Rough walls and clutter make many weak paths that no search finds, and that a Gaussian
process predicts as far as receivers stand within half a wavelength of each other. It is fitted to the
leave-one-out residual of the source model, and weighted by its own leave-one-out predictions.

**ImageEnsemble.** From a few spectra an array's vectors are no better learned than images are, and the two
err differently: where both predict training spectra without their neighbours about equally well, their
weighted mean.

**DirectionalEnsemble.** Sources triangulated from measured directions know the visibility; a search knows
walls and clutter. Both predict, weighted by their leave-one-out errors of the training channels.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from gsparc.auto.decide import Decision, Switch, fifths, nmse_of
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.method import ComparesWithGP, Differentiable, FitContext, LeaveOneOut, LeftOut, Method
from gsparc.methods.registry import method_class
from gsparc.methods.time_budget import Clock, TimeBudget, less_repeatable
from gsparc.ops import Pose

LEVEL_DB = 0.25  # a process on images this far behind an array, both left out alike, is level with it
LEAST_WEIGHT = 0.05  # of a process on images where it is asked for
PROBE_S = 5.0  # after which no further fifth of the rows is held out
LEAST_GAIN = 0.03  # of the left-out residual's power, below which `auto` does without


class Companion(Protocol):
    """Completes the predictions of another method."""

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """The prediction of both, from the other's `mean` at tx (B, 3) [m] and rx."""

    def state(self) -> dict[str, Any]:
        """Everything `restored` needs."""


@dataclass(frozen=True)
class ResidualGP:
    """A process on the residual of a source model.

    Attributes:
        process: fitted to leave-one-out residuals.
        weight: in (0, 1], that of least squared leave-one-out error.
        gain: share of the residual's power that it explains.
    """

    process: Method
    weight: float
    gain: float

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """See `Companion`."""
        return mean + self.weight * _mean_at(self.process, tx, rx)

    def state(self) -> dict[str, Any]:
        """See `Companion`."""
        return {"process": self.process.state(), "weight": self.weight, "gain": self.gain}


@dataclass(frozen=True)
class ImageEnsemble:
    """A process on whole images, averaged with another method.

    Attributes:
        process: fitted to the images.
        weight: in (0, 1], the process's.
    """

    process: Method
    weight: float

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """See `Companion`."""
        return torch.lerp(mean, _mean_at(self.process, tx, rx), self.weight)

    def state(self) -> dict[str, Any]:
        """See `Companion`."""
        return {"beside": self.process.state(), "weight": self.weight}


@dataclass(frozen=True)
class DirectionalEnsemble:
    """Sources of measured directions, averaged with searched ones.

    Attributes:
        sources: of measured directions.
        weight: in (0, 1), theirs.
        rest: completes the searched ones, or None.
    """

    sources: Method
    weight: float
    rest: Companion | None

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """See `Companion`."""
        searched = mean if self.rest is None else self.rest.completed(mean, tx, rx)
        return (1 - self.weight) * searched + self.weight * _mean_at(self.sources, tx, rx)

    def state(self) -> dict[str, Any]:
        """See `Companion`."""
        rest = None if self.rest is None else self.rest.state()
        return {"told": self.sources.state(), "weight": self.weight, "rest": rest}


def restored(site: Site, state: dict[str, Any]) -> Companion:
    """The companion whose `state()` this was."""
    if "told" in state:
        rest = None if state["rest"] is None else restored(site, state["rest"])
        sources = _restored("directional_gp", site, state["told"])
        return DirectionalEnsemble(sources, float(state["weight"]), rest)
    if "beside" in state:
        return ImageEnsemble(_restored("gp", site, state["beside"]), float(state["weight"]))
    process = _restored("complex_gp", site, state["process"])
    return ResidualGP(process, float(state["weight"]), float(state["gain"]))


def left_out_nmse(method: Method, data: Measurements) -> float:
    """Normalised mean squared error of a fitted method, each receiver predicted from all others."""
    left = _left_out(method)
    power = float(np.mean(np.abs(data.target[np.unique(left.rows)]) ** 2))
    return float(left.residual.abs().square().mean()) / max(power, 1e-30)


def held_out_ratio(
    trial: Method, data: Measurements, rows: np.ndarray, seed: int, clock: Clock = "wall"
) -> tuple[float, float, Clock | None]:
    """What short searches on four fifths of the rows predict of the fifth: NMSE, and its ratio to their own
    leave-one-out error, at least 1; and the clock, if its seconds ended something. From few rows a search
    finds sources that fit and are not there.

    As many fifths as `PROBE_S` of the clock allows, at least one.
    """
    budget, limited, held, promised = TimeBudget(PROBE_S, clock), None, [], []
    for number, fold in enumerate(fifths(rows, seed)):
        if number and budget.over():
            break
        limited = less_repeatable(limited, trial.fit(data, fold, FitContext(budget_clock=clock)).limited_by)
        held.append(nmse_of(trial, data, fold.test))
        promised.append(left_out_nmse(trial, data))
    error = float(np.mean(held))
    ratio = max(error / max(float(np.mean(promised)), 1e-30), 1.0)
    return error, ratio, less_repeatable(limited, budget.limited_by)


def weight_of(directed: Method, searched: Method, ratio: float) -> float:
    """The weight in [0, 1] of sources of measured directions beside searched ones.

    That of least squared error where each receiver is predicted from all others, the searched sources' error
    being `ratio` times what it is there.
    """
    own, others = _left_out(directed), _left_out(searched)
    theirs = ratio * float(others.residual.abs().square().mean())
    ours = float(own.residual.abs().square().mean())
    # Of large data each holds other rows: their errors are then taken to have nothing in common.
    same = np.array_equal(own.rows, others.rows)
    common = float((own.residual.conj() * others.residual).real.mean()) if same else 0.0
    return min(max((theirs - common) / max(theirs + ours - 2 * common, 1e-30), 0.0), 1.0)


def learn_companion(
    switch: Switch, model: Method, data: Measurements, fold: Fold
) -> tuple[Decision, Companion | None]:
    """Whether a process is to complete a model, decided by leaving training rows out, and the process.

    Args:
        switch: `auto`, true or false.
        model: fitted on `data`.
        data: all measurements; only rows that the model holds are looked at.
        fold: whose training and validation rows these are.
    """
    started = time.perf_counter()
    if switch is False:
        return Decision("hybrid", False, "as configured"), None
    if isinstance(model, ComparesWithGP):
        return _image_ensemble(switch is True, model, data, fold, started)
    if not isinstance(model, LeaveOneOut):
        return Decision("hybrid", False, "only sources with carrier phase have leave-one-out residuals"), None
    left = model.leave_one_out()
    if data.target[0].size > 1 or left.aligned:
        return Decision("hybrid", False, "it is for one channel per receiver whose phase is known"), None
    target = np.zeros_like(data.target)
    target[left.rows] = left.residual.numpy().reshape(-1, *data.target.shape[1:])
    process, none = method_class("complex_gp")(), left.rows[:0]
    process.fit(replace(data, target=target), Fold(left.rows, none, none), FitContext())
    weight, gain = _worth(process, left.residual.flatten().to(torch.complex128))
    on = weight > 0 and (switch is True or gain >= LEAST_GAIN)
    reason = f"a process explains {max(gain, 0):.0%} of the residual of the sources, left out one by one"
    spent = time.perf_counter() - started
    return Decision("hybrid", on, reason, spent), ResidualGP(process, weight, gain) if on else None


def _image_ensemble(
    wanted: bool, model: ComparesWithGP, data: Measurements, fold: Fold, started: float
) -> tuple[Decision, ImageEnsemble | None]:
    compared = model.compared_with_gp()
    if compared is None:
        return Decision("hybrid", False, "too few spectra to leave any out"), None
    behind, weight = compared
    weight = max(weight, LEAST_WEIGHT) if wanted else weight
    on = wanted or (weight > 0 and behind < LEVEL_DB)
    found = "as good as" if behind < LEVEL_DB else "worse than"
    reason = f"left out, a process on images is {found} the array ({-behind:+.2f} dB)"
    if not on:
        return Decision("hybrid", False, reason, time.perf_counter() - started), None
    process = method_class("gp")()
    process.fit(data, fold, FitContext())
    reason += f", and has weight {weight:.0%}"
    return Decision("hybrid", True, reason, time.perf_counter() - started), ImageEnsemble(process, weight)


def _worth(process: Method, residual: Tensor) -> tuple[float, float]:
    """The weight of least squared error of leave-one-out predictions of residuals (n,), and what it gains."""
    predicted = residual - _left_out(process).residual.flatten().to(residual.dtype)
    overlap = float((predicted.conj() * residual).real.sum())
    weight = min(max(overlap / max(float(predicted.abs().square().sum()), 1e-30), 0.0), 1.0)
    error = (residual - weight * predicted).abs().square().sum()
    return weight, 1 - float(error / residual.abs().square().sum().clamp_min(1e-30))


def _left_out(method: Method) -> LeftOut:
    assert isinstance(method, LeaveOneOut)
    return method.leave_one_out()


def _mean_at(method: Method, tx: Tensor, rx: Pose) -> Tensor:
    assert isinstance(method, Differentiable)
    return method.mean_at(tx, rx)


def _restored(name: str, site: Site, state: dict[str, Any]) -> Method:
    method = method_class(name)()
    method.restore(site, state)
    return method
