"""Which terms a site calls for."""

from dataclasses import replace

import pytest
from invented import invent
from known_arrays import array_site
from refusals import refused

from gsparc.datasets.rfid import planar_array
from gsparc.field.emission import EmissionSettings
from gsparc.field.gaussians import FieldSettings
from gsparc.field.initial import InitSettings
from gsparc.field.model import AttenuationSettings
from gsparc.models.gsparc import Gsparc, choose
from gsparc.models.mixture.mixture import Mixture
from gsparc.models.terms import EffectSettings
from gsparc.ops import SphereGrid


def measured(kind: str):
    """Small data of a kind; what stands before it is left out of the site or added to it."""
    if not kind.endswith("array"):
        data = invent(kind.removeprefix("unplaced "), 20)
        return (
            replace(data, site=replace(data.site, static_position=None))
            if "unplaced" in kind
            else data
        )
    site = array_site(SphereGrid.hemisphere(9, 18), planar_array())
    site = replace(site, static_end="tx") if kind.startswith("moving") else site
    return replace(invent("spectrum", 20), site=site)


def chosen(kind: str, effects=(), init="auto", hidden=0, count=1, **more):
    """The parts of what is in closed form, and whether an array is seen through."""
    data = measured(kind)
    settings = Gsparc(
        EffectSettings(**dict(effects)),
        init=InitSettings(init),
        emission=EmissionSettings(hidden=hidden),
        field=FieldSettings(count=count),
        **more,
    )
    found = choose(data, settings)
    parts = tuple(found.list_candidates(data)) if isinstance(found, Mixture) else ()
    return parts, not parts and found.settings.response.array


@pytest.mark.parametrize(
    ("kind", "given", "parts"),
    [
        ("rssi", {}, ("powers",)),
        ("rssi", {"effects": {"power": False}}, ()),
        ("rssi", {"init": "scene"}, ("scene",)),
        ("csi", {}, ("sources", "diffuse")),
        ("csi", {"count": 0}, ("diffuse",)),
        ("csi", {"effects": {"residual": False}}, ("sources",)),
        ("csi", {"init": "rays"}, ("rays", "diffuse")),
        ("csi", {"init": "diffuse"}, ("diffuse",)),  # was weighed against itself
        ("csi", {"init": "scene"}, ("scene", "diffuse")),
        ("csi", {"hidden": 8}, ()),  # an ablation of networks is not answered by another model
        ("csi", {"init": "uniform"}, ()),
        ("unplaced csi", {}, ("diffuse",)),
        ("spectrum", {"effects": {"visibility": True}}, ()),
        ("array", {}, ()),
        ("moving array", {}, ("bearings", "process")),
        ("moving array", {"effects": {"residual": False}}, ("bearings",)),
    ],
)
def test_what_a_site_calls_for(kind, given, parts, caplog):
    caplog.set_level("INFO", "gsparc")
    assert chosen(kind, **given) == (parts, kind == "array")
    assert kind != "unplaced csi" or "does not say where the static end is" in caplog.messages[-1]


def test_inverse_distance_was_refused_with_advice_that_undid_it(caplog):
    """With an array that is `auto` the Gaussians emit powers;
    one that was asked for stays an error.
    """
    falls = AttenuationSettings(inverse_distance=True)
    caplog.set_level("INFO", "gsparc")
    assert chosen("array", attenuation=falls) == ((), False)
    assert "effects.array -> false: attenuation.inverse_distance=true" in caplog.messages[0]
    with pytest.raises(
        ValueError, match=r"array=true is not possible: attenuation\.inverse_distance"
    ):
        chosen("array", {"array": True}, attenuation=falls)


def test_an_array_may_be_switched_off():
    assert not chosen("array", {"array": False})[1]


@pytest.mark.parametrize(
    ("kind", "effects", "message"),
    [
        (
            "unplaced csi",
            {"phase": True},
            r"effects\.phase=true is not possible: the dataset does not say",
        ),
        ("moving array", {"array": True}, "the receiver moves"),
        (
            "array",
            {"moving_array": True},
            r"moving_array=true is not possible: the receiver stands still",
        ),
        ("spectrum", {"array": True}, "the dataset declares no array or no carrier"),
        (
            "csi",
            {"power": True},
            r"^model\.effects\.power=true is not possible: the target is csi[^\n]*$",
        ),
        ("rssi", {"phase": True}, "the target is rssi, which carries no phase"),
        ("spectrum", {"visibility": False}, "visibility=false is not possible: rasterized"),
        ("csi", {"phase": "splat"}, "one of true, false, auto"),
    ],
)
def test_terms_that_mean_nothing_here(kind, effects, message):
    refused(message, chosen, kind, effects)
