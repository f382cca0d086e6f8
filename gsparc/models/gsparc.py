"""`model=gsparc`: which prior, which renderer and which search a site calls for."""

from __future__ import annotations

from gsparc.data.schema import Measurements
from gsparc.field.initial import InitSettings
from gsparc.models.planned_field import PlannedField
from gsparc.models.terms import EffectSettings, Plan, called_for

PROCESS_ROWS = 1_000  # of a moving array, up to which sources may be worth less than the plain process


class Gsparc(PlannedField):
    """A Gaussian field of the terms that a site calls for; see `plan`."""

    def planned(self, data: Measurements) -> Plan:
        """See `PlannedField.planned`."""
        its = self.settings
        falls = its.attenuation.inverse_distance
        return plan(self.switches, self.init, data, its.emission.hidden, its.field.count, falls)


def plan(
    switches: EffectSettings, init: InitSettings, data: Measurements, hidden: int, count: int = 1,
    distant: bool = False,
) -> Plan:  # fmt: skip
    """The terms for these measurements: the first row of the table that they call for.

    Args:
        switches: as configured.
        init: as configured.
        data: measurements; targets are not looked at.
        hidden: units of the emission's networks: a network is trained by rendering.
        count: of Gaussians to start from; 0 is the residual alone.
        distant: whether emissions fall with the distance of a Gaussian.

    Raises:
        ValueError: a term that is asked for means nothing here.
    """
    terms, site = called_for(switches, init, data, hidden, count, distant), data.site
    plain = switches.residual is not False  # a plain process may stand in, or beside
    several = site.stations is not None and len(site.stations) > 1
    searched = ("sources", "rays") if data.directions is not None else ("sources",)
    placed = count > 0 or not plain
    beside = ("process",) if plain and len(data) <= PROCESS_ROWS else ()
    waves = ("diffuse",) if plain and init.snapshot == "none" else ()  # offsets are known to sources alone
    residual_alone = plain and site.kind == "csi" and site.wavelength is not None and not terms.rendered
    table: tuple[tuple[bool, tuple[str, ...]], ...] = (
        (site.phase_reference == "neighbours", ("aligned",)),  # no phase tells of paths
        (terms.power and init.name == "scene", ("scene",)),  # known walls and a process
        (terms.power and several, ("joint_powers",)),  # a law of the site and a process of each station
        (terms.power, ("powers",)),  # a process of decibels about a distance law
        (terms.moving_array and placed, ("bearings", *beside)),  # triangulated sources, processes of powers
        (terms.phase and placed and init.name == "auto", (*searched, *waves)),  # image sources beside waves
        (terms.phase and placed, (str(init.name), *waves)),
        (residual_alone, ("diffuse",)),  # leakage, a direct wave and a diffuse field
    )
    parts = next((parts for called, parts in table if called), ())
    reasons = [*terms.reasons]
    if not parts and switches.visibility is False:
        raise ValueError(
            "model.effects.visibility=false is not possible: rasterized Gaussians always occlude each other"
        )
    if parts[:1] == ("bearings",) and switches.visibility is True:
        raise ValueError(
            "model.effects.visibility=true is not possible: spectra of a moving array hide nothing"
        )
    if parts == ("diffuse",) and not (terms.phase and placed):
        why = "no Gaussians are asked for" if terms.phase else terms.obstacle or "no phase is asked for"
        reasons.append(f"the residual is all there is: {why}")
    named = init.name in ("auto", "diffuse", *parts)
    options = (*terms.options, *["init.name"] * named, *["model.field.count"] * (not count))
    return Plan(not parts, terms.array and not parts, parts, plain and not parts, tuple(reasons), options)
