"""`model=gsparc`: the method that a site calls for."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from gsparc.data import heeded
from gsparc.data.limits import check_arguments, number, or_null
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import GaussianCloud
from gsparc.data.splits import Fold
from gsparc.models.closed_forms import Bearings, Channels, ClosedForms, ImageSources, Powers
from gsparc.models.method import HasPaths, HasProcess, Method, Reconditions
from gsparc.models.splat.averaged import ImageProcess
from gsparc.models.splat.method import LearnedField
from gsparc.models.stations import LearnsTogether
from gsparc.models.terms import EffectSettings, called_for
from gsparc.processes.powers import PowerProcess
from gsparc.training.context import FitContext, FitReport
from gsparc.training.module import GaussianModule

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choice:
    """The method for a site.

    Attributes:
        name: of the method, by which `model=NAME` has it directly.
        method: unfitted.
        reasons: one line each.
        options: that decided, by their paths; others may be heeded by the method.
    """

    name: str
    method: Method
    reasons: tuple[str, ...]
    options: tuple[str, ...]


def choose(data: Measurements, settings: Gsparc) -> Choice:
    """Return the method of the first row of the table that the measurements call for.

    Args:
        data: measurements; targets are not looked at.
        settings: as configured.

    Raises:
        ValueError: a term that is asked for means nothing here.
    """
    switches, init, model, site = settings.switches, settings.init, settings.rendered.settings, data.site
    count, falls = model.field.count, model.attenuation.inverse_distance
    terms = called_for(switches, init, data, model.emission.hidden, count, falls)
    plain = switches.residual is not False
    placed = count > 0 or not plain
    residual_alone = plain and site.kind == "csi" and site.wavelength is not None and not terms.rendered
    table: tuple[tuple[bool, type[ClosedForms]], ...] = (
        (site.gauge == "free", Channels),
        (terms.power, Powers),
        (terms.moving_array and placed, Bearings),
        (terms.phase and placed, ImageSources),
        (residual_alone, Channels),
    )
    found = next((kind for called, kind in table if called), None)
    reasons, options = [*terms.reasons], [*terms.options, *["model.field.count"] * (not count)]
    if found is None and switches.visibility is False:
        raise ValueError(
            "model.effects.visibility=false is not possible: rasterized Gaussians always occlude each other"
        )
    if found is Bearings and switches.visibility is True:
        raise ValueError(
            "model.effects.visibility=true is not possible: spectra of a moving array hide nothing"
        )
    if found is None:
        settings.rendered.through_array(terms.array)
        settings.rendered.plain = plain
        options += ["init.name"] * (init.name in ("auto", "diffuse"))
        name = "array_process" if terms.array else "image_process"
        return Choice(name, settings.rendered, tuple(reasons), tuple(options))
    if found is Channels and site.gauge != "free":
        why = "no Gaussians are asked for" if terms.phase else terms.obstacle or "no phase is asked for"
        reasons.append(f"the residual is all there is: {why}")
    solved = found(switches, settings.position_std, init)
    solved.sourceless = not count
    return Choice(found.name, solved, tuple(reasons), tuple(options))


def _its(name: str) -> Any:
    """What the method that was chosen has under a name."""
    return property(lambda self: getattr(self.chosen, name))


class Gsparc(LearnsTogether):
    """The method that a site calls for, under one name; see `choose`.

    Args:
        effects: switches of terms.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        name: as it appears in tables.
        **field: see `LearnedField`.
    """

    hands_on: ClassVar[type[Method]] = LearnedField  # whose settings `field` are
    has_gaussians = resumable = True
    stored_names: ClassVar[dict[str, str]] = {
        "steps": "", "position_std": "", "loss.snapshot": "init.snapshot", "refit": "rendered.refit",
        "keep_best": "rendered.keep_best",
    }  # fmt: skip

    def __init__(
        self, effects: EffectSettings = EffectSettings(), position_std: float | None = None,
        name: str = "gsparc", **field: Any,
    ) -> None:  # fmt: skip
        check_arguments(locals(), position_std=or_null(number(0)))
        self.rendered = ImageProcess(name=name, **field)
        self.rendered.chosen_by = type(self)
        self.name, self.guesses, self.init = name, self.rendered.guesses, self.rendered.init
        self.switches, self.position_std = effects, position_std
        self.chosen: Method = self.rendered

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose the method, and fit it."""
        with heeded.apart():
            choice = choose(data, self)
            std = data.position_std if self.position_std is None else np.full(len(data), self.position_std)
        heeded.count(*choice.options)
        for reason in choice.reasons:
            log.info("%s", reason)
        log.info("%s is model=%s here", self.name, choice.name)
        self.site, self.chosen = data.site, choice.method
        self.chosen.name = self.name
        if self.chosen is self.rendered and std is not None and std[[*fold.train, *fold.val]].any():
            log.warning("position_std is not used: it is for channels and powers of one end that moves")
        return self.chosen.fit(data, fold, context)

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        solved = state.get("field") is not None  # a field in closed form says itself what it is
        self.site, self.chosen = site, Channels() if solved else self.rendered
        self.chosen.name = self.name
        self.chosen.restore(site, state)

    predict = _its("predict")
    state = _its("state")
    size = _its("size")
    label = _its("label")
    made = _its("made")
    effects = _its("effects")
    facts = _its("facts")
    objects = _its("objects")
    knobs = _its("knobs")
    contributions = _its("contributions")
    reduced = _its("reduced")
    threads_pay = _its("threads_pay")
    gradient_problem = _its("gradient_problem")
    field_alone = _its("field_alone")
    field = _its("field")
    fitted = _its("fitted")
    steps = _its("steps")
    steps_taken = _its("steps_taken")

    def process(self) -> PowerProcess | None:
        """See `HasProcess`."""
        return self.chosen.process() if isinstance(self.chosen, HasProcess) else None

    def reconditioned(self, data: Measurements, rows: np.ndarray) -> Method | None:
        """See `Reconditions`; of powers without fringes."""
        return self.chosen.reconditioned(data, rows) if isinstance(self.chosen, Reconditions) else None

    def paths(self, query: Query) -> tuple[Tensor, Tensor, Tensor, float]:
        """See `HasPaths`; those of every solution that is made of paths."""
        if not isinstance(self.chosen, HasPaths):
            raise ValueError("its channels are not made of paths")
        return self.chosen.paths(query)

    def gaussians(self, query: Query) -> GaussianCloud:
        """See `HasGaussians`."""
        return self.rendered.gaussians(query)

    def module(self) -> GaussianModule:
        """What Lightning trains, where Gaussians are rendered."""
        return self.rendered.module()

    def trainer_options(self) -> bool:
        """See `TrainsByGradient`."""
        return True
