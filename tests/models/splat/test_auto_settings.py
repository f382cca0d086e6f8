import dataclasses

import pytest

from gsparc.field.emission import EmissionSettings
from gsparc.field.encoding import EncodingSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.model import ModelSettings
from gsparc.models.splat.auto_settings import Choices, apply_choices, resolve_auto


def open_settings(hidden: int = 0, **more) -> ModelSettings:
    emission = EmissionSettings(
        EncodingSettings("auto"),
        **{
            "hidden": hidden,
            "activation": "auto",
            "init_bias": "auto",
            "log_distance": False,
            **more,
        },
    )
    return ModelSettings(field=FieldSettings(placement="auto"), emission=emission)


@pytest.mark.parametrize(
    ("kind", "static_end", "hidden", "want"),
    [
        ("spectrum", "rx", 0, Choices("images", "kernel", "linear", 0.0)),
        ("spectrum", "rx", 16, Choices("sphere", "fourier", "sigmoid", 0.0)),
        ("spectrum", "tx", 0, Choices("uniform", "kernel", "sigmoid", 0.0)),
        ("csi", "rx", 0, Choices("uniform", "kernel", "linear", 0.0)),
        ("csi", "tx", 8, Choices("uniform", "fourier", "linear", 0.0)),
        ("rssi", "tx", 0, Choices("uniform", "kernel", "softplus", pytest.approx(-6.21, abs=0.01))),
    ],
)
def test_what_auto_becomes(campaign, kind, static_end, hidden, want):
    site = campaign(kind, static_end=static_end).site
    choices, notes = resolve_auto(open_settings(hidden), "auto", site)
    assert choices == want
    done = apply_choices(open_settings(hidden), choices)
    found = (done.emission.encoding.kind, done.emission.activation, done.emission.init_bias)
    assert (
        found == (want.encoding, want.activation, want.init_bias) and done.field.placement != "auto"
    )
    assert [n.split("=")[0] for n in notes][:3] == ["encoding.kind", "init", "activation"]
    assert all("auto -> " in note and ": " in note for note in notes)
    if (kind, static_end) == ("spectrum", "tx"):
        assert any(note.startswith("init=auto -> uniform: the receiver moves") for note in notes)


def test_what_is_said_stays_and_needs_no_words(campaign):
    given = dataclasses.replace(
        open_settings(),
        field=FieldSettings(placement="uniform"),
        emission=EmissionSettings(EncodingSettings("raw"), activation="sigmoid", init_bias=0.0),
    )
    choices, notes = resolve_auto(given, "uniform", campaign("spectrum").site)
    assert choices == Choices("uniform", "raw", "sigmoid", 0.0) and notes == ()
    assert apply_choices(given, choices) == given


def test_the_logarithm_of_distance_brings_its_sigmoid(campaign):
    choices, _ = resolve_auto(open_settings(4, log_distance=True), "auto", campaign("rssi").site)
    assert choices.activation == "sigmoid" and choices.init_bias == 0
