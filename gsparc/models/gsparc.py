"""`model=gsparc`: the method that a site calls for."""

from __future__ import annotations

import logging
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from gsparc.data import heeded
from gsparc.data.limits import check_arguments, number, or_null
from gsparc.data.query import Query
from gsparc.data.schema import Measurements, Site
from gsparc.data.site_objects import GaussianCloud
from gsparc.data.splits import Fold
from gsparc.field.module import GaussianModule
from gsparc.models.method import HasPaths, HasProcess, Method, Reconditions
from gsparc.models.mixture.named import Bearings, Channels, ImageSources, NamedMixture, Powers
from gsparc.models.refined_places import errors_of
from gsparc.models.splat.averaged import ImageProcess
from gsparc.models.splat.method import LearnedField
from gsparc.models.stations import LearnsTogether
from gsparc.models.terms import EffectSettings, called_for
from gsparc.processes.powers import PowerProcess
from gsparc.training.context import FitContext, FitReport

log = logging.getLogger(__name__)


def choose(data: Measurements, settings: Gsparc) -> Method:
    """Return the method of the first row of the table that the measurements call for, and log why.

    Args:
        data: measurements; targets are not looked at.
        settings: as configured.

    Returns:
        Unfitted, under the name by which `model=NAME` has it directly.

    Raises:
        ValueError: a term that is asked for means nothing here.
    """
    with heeded.apart():  # what decides is counted below; the method may heed more
        switches, init, model, site = settings.switches, settings.init, settings.rendered.settings, data.site
        count, falls = model.field.count, model.attenuation.inverse_distance
        terms = called_for(switches, init, data, model.emission.hidden, count, falls)
        plain, hides = switches.residual is not False, switches.visibility
        placed = count > 0 or not plain
        residual_alone = plain and site.kind == "csi" and site.wavelength is not None and not terms.rendered
        table: tuple[tuple[bool, type[NamedMixture] | None], ...] = (
            (site.phase_reference == "neighbours", Channels),
            (terms.power, Powers),
            (terms.moving_array and placed, Bearings),
            (terms.phase and placed, ImageSources),
            (residual_alone, Channels),
            (True, None),  # Gaussians are rendered, through an array where there is one
        )
        kind = next(kind for called, kind in table if called)
        if kind in (None, Bearings) and hides is (kind is Bearings):
            why = "rasterized Gaussians always occlude each other"
            why = "spectra of a moving array hide nothing" if hides else why
            raise ValueError(f"model.effects.visibility={str(hides).lower()} is not possible: {why}")
        reasons, options = [*terms.reasons], [*terms.options, *["model.field.count"] * (not count)]
        if kind is Channels and site.phase_reference != "neighbours":
            why = "no Gaussians are asked for" if terms.phase else terms.obstacle or "no phase is asked for"
            reasons.append(f"the residual is all there is: {why}")
        if kind is None:
            method: Method = settings.rendered.called_for(terms.array, plain)
            options += ["init.name"] * (init.name in ("auto", "diffuse"))
        else:
            method = kind(switches, settings.position_std, init, residual_alone=not count)
    heeded.count(*options)
    for reason in reasons:
        log.info("%s", reason)
    return method


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
        self.rendered = ImageProcess(plain=effects.residual is not False, name=name, **field)
        self.rendered.chosen_by = type(self)
        self.name, self.guesses, self.init = name, self.rendered.guesses, self.rendered.init
        self.switches, self.position_std = effects, position_std
        self.chosen: Method = self.rendered

    def fit(self, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
        """Choose the method, and fit it."""
        self.site, self.chosen = data.site, choose(data, self)
        log.info("%s is model=%s here", self.name, self.chosen.name)
        self.chosen.name = self.name
        if context.init_from is not None and self.chosen is not self.rendered:
            raise ValueError(f"init_from: {self.name} is in closed form here, without weights to start from")
        if self.chosen is self.rendered:
            errors_of(data, fold, self.position_std, heeds=False)
        return self.chosen.fit(data, fold, context)

    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """See `Method.restore`."""
        solved = "members" in state  # a field in closed form says itself what it is
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
    only = _its("only")
    parts = _its("parts")
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
        """See `TrainsByGradient`; before `fit` the site has not been seen."""
        return self.chosen is self.rendered
