"""`model=gsparc`: the method that a site calls for."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from gsparc.base.files import Files
from gsparc.base.limits import check_arguments, number, or_null
from gsparc.data.schema import Measurements, Site
from gsparc.models.carriers.array import carriers_obstacle
from gsparc.models.carriers.method import CarrierField
from gsparc.models.method import Method, import_path
from gsparc.models.mixture.each_or_together import LearnsTogether
from gsparc.models.mixture.methods import Bearings, Channels, ImageSources, Powers
from gsparc.models.powers.own_terms import OwnTerms, to_terms
from gsparc.models.refined_places import position_errors
from gsparc.models.splat.image_process import ArrayProcess, ImageProcess
from gsparc.models.splat.method import LearnedField
from gsparc.models.terms import EffectSettings, resolve_terms
from gsparc.models.uplink.method import UplinkField
from gsparc.training.effort import Effort

log = logging.getLogger(__name__)


def choose(data: Measurements, settings: Gsparc, quiet: bool = False) -> Method:
    """Return the method of the first row of the table that the measurements call for, and log why.

    Args:
        data: measurements; targets are not looked at.
        settings: as configured.
        quiet: whether nothing is logged.

    Returns:
        Unfitted, under the name by which `model=NAME` has it directly.

    Raises:
        ValueError: a term that is asked for means nothing here.
    """
    switches, init, model, site = (
        settings.switches,
        settings.init,
        settings.rendered.settings,
        data.site,
    )
    count, falls = model.field.count, model.attenuation.inverse_distance
    terms = resolve_terms(switches, init, data, model.emission.hidden, count, falls)
    plain, hides = switches.residual is not False, switches.visibility
    # No Gaussians means the residual alone, where that is not switched off.
    placed = count > 0 or not plain
    residual_alone = plain and site.has_waves and not terms.rendered
    # The first that is called for: what was heard at the same moment tells more than where it was
    # heard; phases relative to neighbours leave no source to be placed.
    table: tuple[tuple[bool, type[Method]], ...] = (
        (data.uplink is not None, UplinkField),
        (site.phase_reference == "neighbours", Channels),
        (carriers_obstacle(site) is None, CarrierField),
        (terms.power, Powers),
        (terms.moving_array and placed, Bearings),
        (terms.phase and placed, ImageSources),
        (residual_alone, Channels),
        (terms.array, ArrayProcess),
        (True, ImageProcess),
    )
    method_class = next(method for called, method in table if called)
    for remark in settings.own_terms.said if method_class is not Powers else ():
        raise ValueError(f"{remark} of received powers; the target is {site.kind} here")
    rendered = issubclass(method_class, ImageProcess)
    if (rendered and hides is False) or (method_class is Bearings and hides is True):
        why = "rasterized Gaussians always occlude each other"
        why = "spectra of a moving array hide nothing" if hides else why
        raise ValueError(f"model.effects.visibility={str(hides).lower()} is not possible: {why}")
    reasons = [*terms.reasons]
    if method_class is Channels and site.phase_reference != "neighbours":
        why = (
            "no Gaussians are asked for"
            if terms.phase
            else terms.obstacle or ("no phase is asked for")
        )
        reasons.append(f"the residual is all there is: {why}")
    method = settings.create_as(import_path(method_class))
    if quiet:
        return method
    for reason in reasons:
        log.info("%s", reason)
    return method


class Gsparc(LearnsTogether):
    """Makes the method that a site calls for, under one name; see `choose`.

    Args:
        effects: switches of terms.
        position_std: of each coordinate of training positions [m]; None: as the data say.
        terms, prior: see `OwnTerms`.
        name: as it appears in tables.
        **field: see `LearnedField`.
    """

    hands_on: ClassVar[type[Method]] = LearnedField  # whose settings `field` are
    resumable = uses_censored = True

    def __init__(
        self,
        effects: EffectSettings = EffectSettings(),
        position_std: float | None = None,
        terms: Sequence[Any] = (),
        prior: Files | None = None,
        name: str = "gsparc",
        **field: Any,
    ) -> None:
        check_arguments(locals(), position_std=or_null(number(0)))
        self.rendered = ImageProcess(effects.residual is not False, **field)  # checks what it takes
        self.name, self.guesses, self.init = name, self.rendered.guesses, self.rendered.init
        self.switches, self.position_std, self._field = effects, position_std, field
        self.own_terms = OwnTerms(to_terms(terms), prior)

    def learns_jointly(self, site: Site) -> bool:
        """See `LearnsTogether`; carriers of spectra share paths, too."""
        return super().learns_jointly(site) or carriers_obstacle(site) is None

    def describe_fit(self, data: Measurements, effort: Effort, steps: int | None = None) -> str:
        """See `MethodFactory`."""
        method = choose(data, self, quiet=True)
        how = method.describe_fit(data, effort, steps) or "in closed form"
        paper = "; the paper's recipe: paper=gsparc" if not data.site.target.is_level else ""
        return f"{method.name}, {how}{paper}"

    def create_for(self, data: Measurements) -> Method:
        """See `MethodFactory`; the log says what was chosen."""
        method = choose(data, self)
        if isinstance(method, ImageProcess):
            position_errors(data, np.arange(len(data)), self.position_std, can_refine=False)
        log.info("%s is model=%s here", self.name, method.name)
        method.name = self.name
        return method

    def create_as(self, target: str) -> Method:
        """See `MethodFactory`; under its own name."""
        alike = {import_path(solver): solver for solver in (UplinkField, CarrierField)}
        if target in alike:
            return alike[target]()
        solved = {
            import_path(solver): solver for solver in (ImageSources, Channels, Powers, Bearings)
        }
        rendered = {import_path(solver): solver for solver in (ArrayProcess, ImageProcess)}
        alone = not self.rendered.settings.field.count
        method: Method
        if target in solved:
            terms: dict[str, Any] = {**vars(self.own_terms)} if solved[target] is Powers else {}
            method = solved[target](
                self.switches, self.position_std, self.init, residual_alone=alone, **terms
            )
        elif target in rendered:
            # `ArrayProcess` sets it again.
            images = replace(self.rendered.settings.response, array=False)
            method = rendered[target](
                plain=self.rendered.plain, **{**self._field, "response": images}
            )
        else:
            raise ValueError(f"model=gsparc makes no {target}: train again")
        method.further_settings = ("effects", "field") if alone else ("effects",)  # they choose
        return method
