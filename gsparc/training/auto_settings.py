"""Settings left at `auto`, decided from what the site measures: the one place that decides."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from gsparc.data.schema import Site
from gsparc.field.model import ModelSettings

AUTO = "auto"


@dataclass(frozen=True)
class Choices:
    """What `auto` became; stored in checkpoints, so that a model reads back as it was trained.

    Attributes:
        init: as in `FieldSettings`.
        encoding: `kind` of the emission's `EncodingSettings`.
        activation: as in `EmissionSettings`.
        init_bias: as in `EmissionSettings`.
        warm_start: whether the emission starts in closed form.
    """

    init: str
    encoding: str
    activation: str
    init_bias: float
    warm_start: bool


def resolve(
    settings: ModelSettings, warm_start: bool | Literal["auto"], site: Site
) -> tuple[Choices, tuple[str, ...]]:
    """Choices for a site, and one line for each that was `auto`: "init=auto -> uniform: the receiver moves".

    A closed-form start needs spectra, a static receiver, a linear read-out and kernel features. Hidden units
    need an encoding of few values, because each Gaussian has a network of its own.
    """
    emission, spectra, static = settings.emission, site.kind == "spectrum", site.static_end == "rx"
    notes: list[str] = []

    def decide(name: str, given: str, choice: str, reason: str) -> str:
        if given != AUTO:
            return given
        notes.append(f"{name}=auto -> {choice}: {reason}")
        return choice

    still = "spectra of a static receiver"
    why = (still if static else "the receiver moves") if spectra else f"the target is {site.kind}"
    coherent = settings.response
    choice = "backprojection" if coherent.carrier else "sphere" if spectra and static else "uniform"
    init = decide("init", settings.field.init, choice, "carrier phase" if coherent.carrier else why)
    choice = "fourier" if emission.hidden else "kernel"
    encoding = decide("encoding.kind", emission.encoding.kind, choice, f"hidden={emission.hidden}")
    possible = (coherent.carrier or (spectra and static)) and not emission.hidden and encoding == "kernel"
    started = possible if warm_start == AUTO else bool(warm_start)
    if warm_start == AUTO:
        shape = f"hidden={emission.hidden}, encoding.kind={encoding}"
        notes.append(f"warm_start=auto -> {str(possible).lower()}: {why}, {shape}")
    fitting = {"csi": "linear", "rssi": "softplus", "spectrum": "linear" if started else "sigmoid"}
    reason = "a closed-form start" if started else f"the target is {site.kind}"
    if coherent.array:
        fitting["spectrum"], reason = "linear", "fields at an array are signed"
    if emission.log_distance and site.kind != "csi":
        fitting[site.kind], reason = "sigmoid", "log_distance=true"
    activation = decide("activation", emission.activation, fitting[site.kind], reason)
    bias = emission.init_bias
    if bias == AUTO:
        # 500 softplus units of 0.7 each would start at 300 times the mean power.
        bias = 0.0
        if site.kind == "rssi" and activation == "softplus":
            count = max(settings.field.count, 1)
            bias = math.log(math.expm1(1 / count))
            notes.append(f"init_bias=auto -> {bias:.2f}: {count} Gaussians add up to unit power")
    return Choices(init, encoding, activation, float(bias), started), tuple(notes)


def settled(settings: ModelSettings, choices: Choices) -> ModelSettings:
    """The settings with nothing left at `auto`."""
    replace = dataclasses.replace
    encoding = replace(settings.emission.encoding, kind=choices.encoding)
    emission = replace(
        settings.emission, encoding=encoding, activation=choices.activation, init_bias=choices.init_bias
    )
    return replace(settings, field=replace(settings.field, init=choices.init), emission=emission)
