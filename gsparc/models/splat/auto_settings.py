"""Settings left at `auto`, decided from what the site measures: the one place that decides."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from gsparc.data.schema import Site
from gsparc.field.initial import InitName
from gsparc.field.model import ModelSettings

AUTO = "auto"


@dataclass(frozen=True)
class Choices:
    """What `auto` became; stored in checkpoints, so that a model reads back as it was trained.

    Attributes:
        init: `sphere`, `uniform` or `grid`, with random weights; `images` or `vectors`, the sphere
            with weights in closed form.
        encoding: `kind` of the emission's `EncodingSettings`.
        activation: as in `EmissionSettings`.
        init_bias: as in `EmissionSettings`.
    """

    init: str
    encoding: str
    activation: str
    init_bias: float

    @property
    def closed_form(self) -> bool:
        """Whether the emission's read-out is solved before training."""
        return self.init in ("images", "vectors")


def resolve_auto(
    settings: ModelSettings, init: InitName, site: Site
) -> tuple[Choices, tuple[str, ...]]:
    """Return choices for a site, and lines on those left `auto`: "init=auto -> uniform:
    the receiver moves".

    A closed-form start needs spectra, a static receiver, a linear read-out and kernel features.
    Hidden units need an encoding of few values, because each Gaussian has a network of its own.

    Raises:
        ValueError: a closed-form start that these settings or data do not allow.
    """
    emission, spectra, static = settings.emission, site.target.is_image, site.static_end == "rx"
    notes: list[str] = []

    def choose(name: str, setting: str, choice: str, reason: str) -> str:
        if setting != AUTO:
            return setting
        notes.append(f"{name}=auto -> {choice}: {reason}")
        return choice

    still = "spectra of a static receiver"
    why = (still if static else "the receiver moves") if spectra else f"the target is {site.kind}"
    through_array = settings.response.array
    choice = "fourier" if emission.hidden else "kernel"
    encoding = choose("encoding.kind", emission.encoding.kind, choice, f"hidden={emission.hidden}")
    possible = spectra and static and not emission.hidden and encoding == "kernel"
    fitted = "vectors" if through_array else "images"
    choice = fitted if possible else "sphere" if spectra and static else "uniform"
    start = choose(
        "init", init, choice, f"{why}, hidden={emission.hidden}, encoding.kind={encoding}"
    )
    if start in ("images", "vectors") and not (possible and start == fitted):
        needed = "spectra, a static receiver, model.emission.hidden=0 and encoding.kind=kernel"
        array = "with" if start == "vectors" else "without"
        raise ValueError(f"init={start} needs {needed}, {array} effects.array; here {why}")
    started = start in ("images", "vectors")
    # Channels are signed, powers have no ceiling, pixels lie in [0, 1]; solved weights are linear.
    fitting = {"csi": "linear", "rssi": "softplus", "spectrum": "linear" if started else "sigmoid"}
    reason = "a closed-form start" if started else f"the target is {site.kind}"
    if through_array:
        fitting["spectrum"], reason = "linear", "fields at an array are signed"
    if emission.log_distance and not site.target.is_complex:
        fitting[site.kind], reason = "sigmoid", "log_distance=true"
    activation = choose("activation", emission.activation, fitting[site.kind], reason)
    bias = emission.init_bias
    if bias == AUTO:
        # 500 softplus units of 0.7 each would start at 300 times the mean power.
        bias = 0.0
        if site.target.is_level and activation == "softplus":
            count = max(settings.field.count, 1)
            # Inverse of softplus, at 1 / count.
            bias = math.log(math.expm1(1 / count))
            notes.append(f"init_bias=auto -> {bias:.2f}: {count} Gaussians add up to unit power")
    return Choices(start, encoding, activation, float(bias)), tuple(notes)


def apply_choices(settings: ModelSettings, choices: Choices) -> ModelSettings:
    """Return the settings with nothing left at `auto`."""
    replace = dataclasses.replace
    encoding = replace(settings.emission.encoding, kind=choices.encoding)
    emission = replace(
        settings.emission,
        encoding=encoding,
        activation=choices.activation,
        init_bias=choices.init_bias,
    )
    placement = choices.init if choices.init in ("uniform", "grid") else "sphere"
    return replace(settings, field=replace(settings.field, placement=placement), emission=emission)
