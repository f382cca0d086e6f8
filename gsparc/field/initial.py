"""Where the training of a field starts: what an initialiser is given, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from torch import Tensor

from gsparc.base.limits import POSITIVE, Checked, choice, setting, whole
from gsparc.data.schema import Measurements
from gsparc.field.encoding import Smoothness
from gsparc.field.model import GaussianModel, ModelSettings
from gsparc.ops import Pose
from gsparc.training.stopwatch import Stopwatch

Snapshot = Literal["none", "phase", "phase_timing"]  # what every channel snapshot has of its own


InitName = Literal[
    "auto",
    "sphere",
    "uniform",
    "grid",
    "images",
    "vectors",
    "sources",
    "rays",
    "bearings",
    "diffuse",
    "scene",
]


@dataclass(frozen=True)
class InitSettings(Checked):
    """Where a field's Gaussians come from; one instance of the config group `init`.

    Attributes:
        name: `sphere` around a static receiver, `uniform` and `grid` in the scene box, with random
            weights; `images`, the sphere with weights fitted to spectra; `vectors`, the same
            through an array whose phases are retrieved; `sources`, image sources searched for;
            `rays`, where measured directions meet; `bearings`, where those of a moving array cross;
            `scene`, mirror images in known walls;
            `diffuse`, nowhere: the residual alone.
        file: of the walls, for `scene`.
        searches: of sources: how many, with different seeds; all are kept and averaged.
        search_rows, rows: receivers times tones of a search, and of the final weights.
        margin: around the scene box in which sources are sought [m].
        max_sources: of a search.
        order: largest number of reflections.
        snapshot: what every channel snapshot has of its own, to be estimated; see `LossSettings`.
    """

    name: InitName = setting("auto", choice(*get_args(InitName)))
    file: str | None = None
    searches: int = setting(4, whole(1))
    search_rows: int = setting(700, whole(8))
    rows: int = setting(3000, whole(8))
    margin: float = setting(8.0, POSITIVE)
    max_sources: int = setting(60, whole(1))
    order: int = setting(3, whole(0))
    snapshot: Snapshot = setting("none", choice(*get_args(Snapshot)))


@dataclass(frozen=True)
class InitTask:
    """What initial values are wanted for.

    Attributes:
        settings: of the model.
        closed_form: whether the emission's read-out is solved before training.
        data: all measurements.
        rows: (n,) to learn from.
        receiver: the static one's pose; None where it moves.
        transmitter: (3,) [m], the static one's; None where it moves.
        seed: of every random choice.
        run_dir: where reports go.
        watch: of the fit.
    """

    settings: ModelSettings
    closed_form: bool
    data: Measurements
    rows: np.ndarray
    receiver: Pose | None
    transmitter: Tensor | None
    seed: int
    run_dir: Path
    watch: Stopwatch

    @property
    def most_anchors(self) -> int:
        """Largest number of places that kernel features are anchored at."""
        return self.settings.emission.encoding.anchors


@dataclass(frozen=True)
class Start:
    """Where training begins.

    Attributes:
        prior: features of the encodings, or None.
        solve: sets the parameters of a fresh model, and may return what `left_out` holds; None:
            they stay random.
        left_out: training targets that it predicted without their neighbours, for whoever asks; not
            stored.
    """

    prior: Smoothness | None
    solve: Callable[[GaussianModel], Any] | None = None
    left_out: Any = None
