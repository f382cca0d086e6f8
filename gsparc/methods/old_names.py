"""Names that checkpoints of earlier versions hold, and what they are called now."""

from __future__ import annotations

from typing import Any

OLD_NAMES: dict[str, str] = {  # classes, by import path
    "gsparc.array.field.ArrayField": "gsparc.array.method.ArrayField",
    "gsparc.array.moving.method.BearingField": "gsparc.array.moving.method.MovingArrayField",
    "gsparc.array.moving.method.TrendSettings": "gsparc.array.moving.power_gp.TrendSettings",
    "gsparc.bearings.field.BearingField": "gsparc.array.moving.method.MovingArrayField",
    "gsparc.bearings.field.TrendSettings": "gsparc.array.moving.power_gp.TrendSettings",
    "gsparc.bearings.sources.SearchSettings": "gsparc.array.moving.triangulate.SearchSettings",
    "gsparc.auto.method.Gsparc": "gsparc.training.gsparc.Gsparc",
    "gsparc.best.Gsparc": "gsparc.training.gsparc.Gsparc",
    "gsparc.coherent.complex_gp.ComplexGP": "gsparc.multipath.complex_gp.ComplexGP",
    "gsparc.coherent.directed.DirectedSources": "gsparc.multipath.directional_gp.DirectionalGP",
    "gsparc.coherent.vsgp.VirtualSourceGP": "gsparc.multipath.image_source_gp.ImageSourceGP",
    "gsparc.confidence.ConfidenceSettings": "gsparc.field.confidence.ConfidenceSettings",
    "gsparc.auto.decide.EffectSettings": "gsparc.training.terms.EffectSettings",
    "gsparc.effects.EffectSettings": "gsparc.training.terms.EffectSettings",
    "gsparc.emission.EmissionSettings": "gsparc.field.emission.EmissionSettings",
    "gsparc.encoding.EncodingSettings": "gsparc.field.encoding.EncodingSettings",
    "gsparc.field.FieldSettings": "gsparc.field.gaussians.FieldSettings",
    "gsparc.model.AttenuationSettings": "gsparc.field.model.AttenuationSettings",
    "gsparc.model.RasterSettings": "gsparc.field.model.RasterSettings",
    "gsparc.module.LossSettings": "gsparc.training.lightning_module.LossSettings",
    "gsparc.multipath.directional_gp.DirectedSources": "gsparc.multipath.directional_gp.DirectionalGP",
    "gsparc.multipath.image_source_gp.VirtualSourceGP": "gsparc.multipath.image_source_gp.ImageSourceGP",
    "gsparc.peers.gp.GaussianProcess": "gsparc.methods.gp.GaussianProcess",
    "gsparc.peers.idw.InverseDistance": "gsparc.methods.idw.InverseDistance",
    "gsparc.peers.kriging.Kriging": "gsparc.methods.kriging.Kriging",
    "gsparc.peers.mean.Mean": "gsparc.methods.mean.Mean",
    "gsparc.peers.nearest.Nearest": "gsparc.methods.nearest.Nearest",
    "gsparc.peers.ridge.Ridge": "gsparc.methods.ridge.Ridge",
    "gsparc.peers.zero.Zero": "gsparc.methods.zero.Zero",
    "gsparc.response.ResponseSettings": "gsparc.field.response.ResponseSettings",
    "gsparc.schedule.OptimizerSettings": "gsparc.training.optimizer.OptimizerSettings",
    "gsparc.uplink.method.UplinkField": "gsparc.multipath.uplink.method.UplinkField",
    "gsparc.uplink.search.SearchSettings": "gsparc.multipath.uplink.search.SearchSettings",
}
OLD_KEYS = {"furniture": "clutter"}  # settings of models
FIELD = "gsparc.training.gsparc.Gsparc"
CHOSEN = (  # settings of the models that it chose among
    *("phase_model", "phase_probe", "array_model", "moving_array_model", "directional_model"),
    *("bearing_model", "directed_model", "warm_start"),
)
EFFECTS = "gsparc.training.terms.EffectSettings"
GONE = {  # arguments that a class of that path no longer takes
    "gsparc.array.method.ArrayField": ("packets", "rows", "cache", "seed"),
}


def renamed(node: Any) -> Any:
    """A configuration (plain containers) of an earlier version in today's names, without what is gone."""
    if isinstance(node, dict):
        now = {str(OLD_KEYS.get(key, key)): renamed(value) for key, value in node.items()}
        target = now.get("_target_")
        if target == FIELD and "warm_start" in now:
            return _one_field(now)
        gone = GONE.get(target, ()) if isinstance(target, str) else ()
        return {key: value for key, value in now.items() if key not in gone}
    if isinstance(node, list):
        return [renamed(value) for value in node]
    return OLD_NAMES.get(node, node) if isinstance(node, str) else node


def _one_field(node: dict[str, Any]) -> dict[str, Any]:
    """Settings of `model=gsparc` from when it chose among other methods: those of its own field."""
    found = {key: value for key, value in node.items() if key not in CHOSEN}
    effects = found.get("effects") or {}
    found["effects"] = {"_target_": EFFECTS, "array": effects.get("array") == "splat"}
    for part, gone in (("field", "init"), ("response", "carrier")):
        if isinstance(found.get(part), dict):
            found[part] = {key: value for key, value in found[part].items() if key != gone}
    return found
