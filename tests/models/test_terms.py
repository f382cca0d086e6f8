"""Which terms a site calls for."""

from __future__ import annotations

from dataclasses import replace

import pytest
from invented import invent
from known_arrays import array_site

from gsparc.data.datasets.rfid import planar_array
from gsparc.field.initial import InitSettings
from gsparc.models.gsparc import plan
from gsparc.models.terms import EffectSettings
from gsparc.ops import SphereGrid

AUTO, ANY = EffectSettings(), InitSettings()


def channels(**site):
    data = invent("csi", 20)
    return replace(data, site=replace(data.site, **site))


def test_powers_have_their_law_and_shadows():
    assert plan(AUTO, ANY, invent("rssi", 20), 0).parts == ("powers",)
    assert plan(EffectSettings(power=False), ANY, invent("rssi", 20), 0).rasterized


def test_channels_have_sources_and_what_comes_from_everywhere():
    assert plan(AUTO, ANY, channels(), 0).parts == ("sources", "diffuse")
    assert plan(AUTO, ANY, channels(), 0, count=0).parts == ("diffuse",)
    assert plan(EffectSettings(residual=False), ANY, channels(), 0).parts == ("sources",)
    assert plan(AUTO, InitSettings("rays"), channels(), 0).parts == ("rays", "diffuse")


def test_channels_from_nowhere_known_have_no_sources():
    unplaced = channels(static_position=None)
    found = plan(AUTO, ANY, unplaced, 0)
    assert found.parts == ("diffuse",) and "does not say where the static end is" in found.reasons[-1]
    with pytest.raises(ValueError, match=r"effects\.phase=true is not possible: the dataset does not say"):
        plan(EffectSettings(phase=True), ANY, unplaced, 0)


def test_an_array_takes_part_where_it_is_declared():
    site = array_site(SphereGrid.hemisphere(9, 18), planar_array())
    still = replace(invent("spectrum", 20), site=site)
    assert plan(AUTO, ANY, still, 0).array and not plan(EffectSettings(array=False), ANY, still, 0).array
    moving = replace(still, site=replace(site, static_end="tx"))
    assert plan(AUTO, ANY, moving, 0).parts == ("bearings", "process")
    alone = EffectSettings(residual=False)
    assert plan(alone, ANY, moving, 0).parts == ("bearings",)
    with pytest.raises(ValueError, match="the receiver moves"):
        plan(EffectSettings(array=True), ANY, moving, 0)


def test_an_ablation_of_the_networks_is_not_answered_by_another_model():
    assert plan(AUTO, ANY, channels(), 8).rasterized
    assert plan(AUTO, InitSettings("uniform"), channels(), 0).rasterized


def test_a_switch_says_what_it_may_be():
    with pytest.raises(ValueError, match="one of true, false, auto"):
        EffectSettings(phase="splat")


def test_known_walls_serve_channels_and_powers():
    scene = InitSettings("scene", file="room.yaml")
    assert plan(AUTO, scene, channels(), 0).parts == ("scene", "diffuse")
    assert plan(AUTO, scene, invent("rssi", 20), 0).parts == ("scene",)


@pytest.mark.parametrize(
    ("kind", "site", "effects", "count", "said"),
    [
        ("spectrum", {}, {}, 1, "the target is spectrum; walls mirror channels"),
        ("csi", {"static_position": None}, {}, 1, "the dataset does not say where the static end is"),
        ("rssi", {"static_position": None}, {}, 1, "the dataset does not say where the static end is"),
        ("csi", {}, {"phase": False}, 1, r"model\.effects\.phase=false"),
        ("csi", {}, {}, 0, r"model\.field\.count=0 is the residual alone"),
        ("rssi", {}, {"visibility": False}, 1, "of received powers walls only hide"),
    ],
)  # fmt: skip
def test_what_known_walls_cannot_serve(kind, site, effects, count, said):
    data = invent(kind, 20)
    data = replace(data, site=replace(data.site, **site))
    with pytest.raises(ValueError, match=f"init=scene is not possible: .*{said}"):
        plan(EffectSettings(**effects), InitSettings("scene"), data, 0, count)


def test_rasterized_gaussians_always_occlude_each_other():
    with pytest.raises(ValueError, match=r"visibility=false is not possible: rasterized"):
        plan(EffectSettings(visibility=False), ANY, invent("spectrum", 20), 0)
    assert plan(EffectSettings(visibility=True), ANY, invent("spectrum", 20), 0).rasterized
