"""What gradient training begins with: features of the emission, places of Gaussians, weights in closed form.

Which start a field takes follows from its target: images (`gsparc.training.closed_form`), vectors of an array
(`gsparc.array.splat_init`) or sources with carrier phase (`gsparc.multipath.splat_init`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from torch import Tensor

from gsparc.array import splat_init as through_array
from gsparc.data.schema import Measurements
from gsparc.field.encoding import Prior
from gsparc.field.losses import Snapshot
from gsparc.field.model import GaussianModel, ModelSettings
from gsparc.multipath import splat_init as with_carrier
from gsparc.ops import Pose
from gsparc.training.auto_settings import Choices
from gsparc.training.closed_form import learn_prior, warm_start

UNIFORM_GAINS = with_carrier.Gains(length=2.0, constant=0.8, noise=0.1)


@dataclass(frozen=True)
class Start:
    """A start, before there is a model.

    Attributes:
        prior: features of the emission; None when they need none.
        sources: (N, 3) [m] where the Gaussians stand; None when the field places them.
        solve: sets a fresh model's weights.
        billed_s, waited_s: seconds that reusable work cost when it was done, and now [s].
    """

    prior: Prior | None
    sources: Tensor | None
    solve: Callable[[GaussianModel], None]
    billed_s: float = 0.0
    waited_s: float = 0.0


def prepare(
    settings: ModelSettings,
    choices: Choices,
    data: Measurements,
    rows: np.ndarray,
    ends: tuple[Pose | None, Tensor | None],
    snapshot: Snapshot,
    seed: int,
    run_dir: Path,
) -> Start:
    """The start on the given training rows.

    Args:
        settings, choices: of the model.
        data: all measurements.
        rows: (n,) to learn from.
        ends: the static receiver's pose and the static transmitter (3,) [m], None where that end moves.
        snapshot: what every snapshot has of its own.
        seed: of every random choice.
        run_dir: where reports go.

    Raises:
        ValueError: a start is asked for that the data do not allow.
    """
    receiver, transmitter = ends
    anchors = settings.emission.encoding.anchors
    if settings.response.carrier:
        return _with_carrier(choices, data, rows, transmitter, snapshot, anchors, seed)
    if choices.init == "backprojection":
        raise ValueError("model.field.init=backprojection needs model.effects.phase=splat")
    if settings.response.array and choices.warm_start:
        assert receiver is not None
        found = through_array.settled_vectors(data, rows, anchors, seed, run_dir)
        begin = partial(through_array.start, data=data, found=found, receiver=receiver)
        return Start(found.prior, None, begin, found.billed_s, found.waited_s)
    kernel = "kernel" in (choices.encoding, settings.confidence.encoding.kind)
    prior = learn_prior(data, rows, anchors, seed) if kernel else None
    if not choices.warm_start:
        return Start(prior, None, _as_it_is)
    if data.site.kind != "spectrum" or receiver is None or prior is None:
        raise ValueError(
            "model.warm_start=true needs spectra, a static receiver and model.emission.encoding.kind=kernel"
        )
    return Start(prior, None, partial(warm_start, data=data, rows=rows, receiver=receiver, noise=prior.noise))


def _as_it_is(model: GaussianModel) -> None:
    """Random weights stay."""


def _with_carrier(
    choices: Choices,
    data: Measurements,
    rows: np.ndarray,
    transmitter: Tensor | None,
    snapshot: Snapshot,
    anchors: int,
    seed: int,
) -> Start:
    assert transmitter is not None
    if choices.init == "backprojection":
        found = with_carrier.searched(data, rows, snapshot, seed)
        gains = with_carrier.likeliest(found)
        prior = with_carrier.prior_of(data, rows, gains, anchors, seed)
        if not choices.warm_start:
            return Start(prior, found.position, _as_it_is)
        solve = partial(with_carrier.solve, sources=found, gains=gains, transmitter=transmitter)
        return Start(prior, found.position, solve)
    prior = with_carrier.prior_of(data, rows, UNIFORM_GAINS, anchors, seed)

    def solve_there(model: GaussianModel) -> None:
        there = with_carrier.anywhere(data, rows, model.gaussians.means.detach(), seed)
        with_carrier.solve(model, there, UNIFORM_GAINS, transmitter)

    return Start(prior, None, solve_there if choices.warm_start else _as_it_is)
