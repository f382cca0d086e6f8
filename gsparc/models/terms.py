"""Terms of a field: their switches, and which of them mean something at a site."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsparc.base.limits import Checked, setting, switch
from gsparc.data.schema import End, Measurements, Site
from gsparc.field.initial import InitSettings

Switch = bool | Literal["auto"]
SWITCH = switch("auto")


@dataclass(frozen=True)
class EffectSettings(Checked):
    """Switches of terms: `auto`, true or false; off means not computed.

    Attributes:
        image: rasterized Gaussians emit what arrives, without phase.
        array: spectra arise in the static receiver's array: Gaussians emit fields, the array images
            them.
        moving_array: the same of a receiver that moves, in powers: sources seen through the array's
            lags.
        phase: carrier phase from places of sources, for channels.
        power: distance law in decibels and known walls along the path, for received powers.
        visibility: what hides: occluding boxes and finite mirrors of sources, which receivers
            measured directions point to, known walls of powers and, of stations never heard,
            shadowing of a place; rasterized Gaussians always occlude each other.
        residual: a process in the target's own correlation on what Gaussians leave.
    """

    image: Switch = setting("auto", SWITCH)
    array: Switch = setting("auto", SWITCH)
    moving_array: Switch = setting("auto", SWITCH)
    phase: Switch = setting("auto", SWITCH)
    power: Switch = setting("auto", SWITCH)
    visibility: Switch = setting("auto", SWITCH)
    residual: Switch = setting("auto", SWITCH)


@dataclass(frozen=True)
class Terms:
    """Which terms are on.

    Attributes:
        array, moving_array, phase, power: see `EffectSettings`.
        rendered: whether rendered Gaussians are asked for.
        obstacle: why there is no carrier phase, where there can be none.
        reasons: one line each.
    """

    array: bool
    moving_array: bool
    phase: bool
    power: bool
    rendered: bool
    obstacle: str | None
    reasons: tuple[str, ...]


def resolve_terms(
    switches: EffectSettings,
    init: InitSettings,
    data: Measurements,
    hidden: int,
    count: int,
    falls: bool,
) -> Terms:
    """Return the terms that mean something here and are not switched off;
    see `gsparc.models.gsparc.choose`.

    `falls`: whether emissions fall with the distance,
    which makes them no linear read-out of an array.

    Raises:
        ValueError: a term that is asked for means nothing here.
    """
    site = data.site
    networks = f"emission.hidden={hidden}" if hidden else None
    seeded = init.name in ("sphere", "uniform", "grid") and not site.target.is_level
    placed = f"init={init.name}" if seeded else None
    request = networks or placed  # asks for Gaussians that are rendered
    distance = falls and init.name != "vectors"
    obstacles = {
        "array": array_obstacle(site, "rx", "the receiver moves")
        or (networks and f"{networks} asks for networks")
        or ("attenuation.inverse_distance=true leaves no linear read-out" if distance else None),
        "moving_array": array_obstacle(site, "tx", "the receiver stands still")
        or (request and f"{request} asks for rendered Gaussians"),
        "phase": phase_obstacle(data) or (request and f"{request} asks for rendered Gaussians"),
        "power": None if site.target.is_level else f"the target is {site.kind}",
    }
    on, reasons = {}, list[str]()
    for name, obstacle in obstacles.items():
        switch = getattr(switches, name)
        if switch is True and obstacle is not None:
            raise ValueError(f"model.effects.{name}=true is not possible: {obstacle}")
        on[name] = switch is not False and obstacle is None
        if obstacle is None or "=" in obstacle:  # other settings decide, not the data
            why = obstacle if switch == "auto" else "as configured"
            reasons.append(
                f"effects.{name} -> {str(on[name]).lower()}" + (f": {why}" if why else "")
            )
    if init.name == "scene":
        _refuse_scene(data, switches, obstacles, on, count)
    rendered = request is not None or switches.image is True
    return Terms(**on, rendered=rendered, obstacle=obstacles["phase"], reasons=tuple(reasons))


def _refuse_scene(
    data: Measurements,
    switches: EffectSettings,
    obstacles: dict[str, str | None],
    on: dict[str, bool],
    count: int,
) -> None:
    """`ValueError` where known walls explain nothing."""
    site, why = data.site, None
    term = {"csi": "phase", "rssi": "power"}.get(site.kind)
    if term is None:
        why = (
            f"the target is {site.kind}; walls mirror channels and stand in the way of "
            "received powers"
        )
    elif not on[term]:
        why = obstacles[term] or f"model.effects.{term}=false"
    elif not count:
        why = "model.field.count=0 is the residual alone"
    elif site.target.is_level and site.several:
        why = "known walls are of one station's model; say stations=each"
    elif site.target.is_level and not site.paired and site.static_position is None:
        why = "the dataset does not say where the static end is"
    elif site.target.is_level and switches.visibility is False:
        why = "of received powers walls only hide, which model.effects.visibility=false turns off"
    if why is not None:
        raise ValueError(f"init=scene is not possible: {why}")


def array_obstacle(site: Site, still: End, wrong_end_message: str) -> str | None:
    """Say why spectra arise in no array of a receiver that stands (`rx`) or moves (`tx` stands)."""
    if not site.target.is_image:
        return f"the target is {site.kind}, not a spectrum"
    if site.static_end != still:
        return wrong_end_message
    # One antenna tells no directions, nor does any array without a wavelength.
    if site.array is None or len(site.array) < 2 or site.wavelength is None:
        return "the dataset declares no array or no carrier"
    return None


def phase_obstacle(data: Measurements) -> str | None:
    """Say why channels have no carrier phase that tells of places; None where they have."""
    site = data.site
    if not site.target.is_complex:
        return f"the target is {site.kind}, which carries no phase"
    if site.several:
        return "several stations are learned together, for which sources are not searched"
    if site.static_position is None:
        return "the dataset does not say where the static end is"
    if site.carrier_hz is None and site.subcarriers_hz is None:
        return "the dataset declares no frequency"
    return None
