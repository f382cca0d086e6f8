"""A process beside physics: of what sources leave over, or of whole images where it is as good as an array.

**Rest.** Rough walls and clutter make many weak paths that no search finds, and that a Gaussian process
knows as far as receivers stand within half a wavelength of each other. It is taught what each receiver
measured less what the sources of all *other* receivers say, and counts by its own left-out predictions.

**Beside.** From a few spectra an array's vectors are no better learned than images are, and the two err
differently: where both predict training spectra without their neighbours about equally well, the mean of both
answers, weighted by these predictions.

**Told.** Sources where measured directions of arrival meet know who sees what; a search knows walls and
furniture. Both answer, weighted by their left-out predictions of the training channels.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsparc.array.cross_validation import LeftOut, without
from gsparc.array.method import ArrayField
from gsparc.auto.decide import Decision, Switch, fifths, nmse_of
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold
from gsparc.methods.gp import GaussianProcess, choose_kernel
from gsparc.methods.method import Method
from gsparc.multipath.complex_gp import ComplexGP
from gsparc.multipath.directional_gp import DirectedSources
from gsparc.multipath.image_source_gp import VirtualSourceGP
from gsparc.ops import Pose

LEVEL_DB = 0.25  # a process of images this far behind an array, left out, is level with it
WEIGHTS = np.linspace(0, 1, 21)
PROBE_S = 5.0  # after which no further fifth of the rows is held out
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

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """What physics says, with it."""
        return mean + self.at(rx.position.reshape(-1, 3).expand(len(tx), 3))

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs."""
        return {"process": self.process.state(), "weight": self.weight, "gain": self.gain}

    @staticmethod
    def restore(site: Site, state: dict[str, Any]) -> Rest:
        """The one whose `state()` this was."""
        process = ComplexGP()
        process.restore(site, state["process"])
        return Rest(process, float(state["weight"]), float(state["gain"]))


@dataclass(frozen=True)
class Beside:
    """A process of whole images that answers with the physics.

    Attributes:
        process: taught the images.
        weight: in (0, 1], its say.
    """

    process: GaussianProcess
    weight: float

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """What physics says (B, H, W), averaged with it."""
        return torch.lerp(mean, self.process.mean_at(tx), self.weight)

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs."""
        return {"beside": self.process.state(), "weight": self.weight}


@dataclass(frozen=True)
class Told:
    """Sources of measured directions that answer with searched ones.

    Attributes:
        sources: of measured directions.
        weight: in (0, 1), their say.
        rest: a process that completes the searched ones, or None.
    """

    sources: DirectedSources
    weight: float
    rest: Rest | None

    def completed(self, mean: Tensor, tx: Tensor, rx: Pose) -> Tensor:
        """What searched sources say (B, A, K), averaged with these."""
        searched = mean if self.rest is None else self.rest.completed(mean, tx, rx)
        return (1 - self.weight) * searched + self.weight * self.sources.mean_at(tx, rx)

    def state(self) -> dict[str, Any]:
        """Everything `restore` needs."""
        rest = None if self.rest is None else self.rest.state()
        return {"told": self.sources.state(), "weight": self.weight, "rest": rest}


Companion = Rest | Beside | Told


def restored(site: Site, state: dict[str, Any]) -> Companion:
    """The one whose `state()` this was."""
    if "told" in state:
        sources = DirectedSources()
        sources.restore(site, state["told"])
        rest = None if state["rest"] is None else Rest.restore(site, state["rest"])
        return Told(sources, float(state["weight"]), rest)
    if "beside" not in state:
        return Rest.restore(site, state)
    process = GaussianProcess()
    process.restore(site, state["beside"])
    return Beside(process, float(state["weight"]))


def left_out_nmse(method: DirectedSources | VirtualSourceGP, data: Measurements) -> float:
    """Normalised mean squared error of a fitted method, each receiver predicted from all others."""
    receivers, left = method.left_over()
    power = float(np.mean(np.abs(data.target[np.unique(receivers)]) ** 2))
    return float(left.abs().square().mean()) / max(power, 1e-30)


def searched_beyond(
    trial: VirtualSourceGP, data: Measurements, rows: np.ndarray, seed: int
) -> tuple[float, float]:
    """What short searches on four fifths of the rows predict of the fifth: NMSE, and how many times the error
    that their own left-out channels promise. From few rows a search finds sources that fit and are not there.

    As many fifths as `PROBE_S` allows, at least one.
    """
    started, held, promised = time.perf_counter(), [], []
    for fold in fifths(rows, seed):
        trial.fit(data, fold, Path())
        held.append(nmse_of(trial, data, fold.test))
        promised.append(left_out_nmse(trial, data))
        if time.perf_counter() - started > PROBE_S:
            break
    error = float(np.mean(held))
    return error, max(error / max(float(np.mean(promised)), 1e-30), 1.0)


def weight_of(directed: DirectedSources, searched: VirtualSourceGP, optimism: float) -> float:
    """The say in [0, 1] of sources of measured directions beside searched ones.

    That of least squared error where each receiver is predicted from all others, the searched sources' error
    being `optimism` times what it is there.
    """
    receivers, left = directed.left_over()
    others, beside = searched.left_over()
    theirs, own = optimism * float(beside.abs().square().mean()), float(left.abs().square().mean())
    # Of large data each holds other rows: their errors are then taken to have nothing in common.
    same = np.array_equal(receivers, others)
    common = float((left.conj() * beside).real.mean()) if same else 0.0
    return min(max((theirs - common) / max(theirs + own - 2 * common, 1e-30), 0.0), 1.0)


def learn_rest(
    switch: Switch, physics: Method, data: Measurements, fold: Fold
) -> tuple[Decision, Rest | Beside | None]:
    """Whether a process is to help, decided by leaving training rows out, and the process.

    Args:
        switch: `auto`, true or false.
        physics: fitted on `data`.
        data: all measurements; only rows that physics holds are looked at.
        fold: whose training and validation rows these are.
    """
    started = time.perf_counter()
    if isinstance(physics, ArrayField) and switch is not False:
        return _beside(switch is True, physics, data, fold, started)
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


def _beside(
    wanted: bool, physics: ArrayField, data: Measurements, fold: Fold, started: float
) -> tuple[Decision, Beside | None]:
    if physics.left_out is None:
        return Decision("hybrid", False, "too few spectra to leave any out"), None
    behind, weight = compared(physics.left_out)
    weight = max(weight, float(WEIGHTS[1])) if wanted else weight
    on = wanted or (weight > 0 and behind < LEVEL_DB)
    found = "as good as" if behind < LEVEL_DB else "worse than"
    reason = f"left out, a process of images is {found} the array ({-behind:+.2f} dB)"
    if not on:
        return Decision("hybrid", False, reason, time.perf_counter() - started), None
    process = GaussianProcess()
    process.fit(data, fold, Path())
    reason += f", and has {weight:.0%} of the say"
    return Decision("hybrid", True, reason, time.perf_counter() - started), Beside(process, weight)


def compared(left: LeftOut) -> tuple[float, float]:
    """How far a process of images is behind what was predicted [dB], and its best weight in their mean.

    On the same samples, gaps and pixels; its kernel is chosen on all of them.
    """
    mean = left.images.mean(0)
    vectors, lengths, _ = np.linalg.svd(left.images - mean, full_matrices=False)
    kernel = choose_kernel(left.positions, vectors * lengths, len(mean))
    inverse = np.linalg.inv(kernel.gram(left.positions))
    distance = np.linalg.norm(left.positions[:, None] - left.positions[None], axis=-1)
    said = mean + without(inverse, left.images - mean, distance, left.centres, left.gaps)[0]
    error = [left.mismatch_db((1 - w) * left.drawn + w * said) for w in WEIGHTS]
    return error[-1] - error[0], float(WEIGHTS[int(np.argmin(error))])


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
