"""What `model=gsparc` keeps in a checkpoint: fields made of fields, and states of earlier versions."""

from __future__ import annotations

from typing import Any

from gsparc.data.schema import Site
from gsparc.field.conditional import CompletedField, ConditionalField, StackedField
from gsparc.methods.registry import field_restored


def as_today(state: dict[str, Any]) -> dict[str, Any]:
    """A state of today's keys, of one from when `model=gsparc` chose among other methods.

    Raises:
        ValueError: it had chosen what is no longer there.
    """
    if "chosen" not in state:
        return state
    chosen = {"bearings": "moving_array"}.get(state["chosen"], state["chosen"])
    if chosen == "array":
        raise ValueError("it is made of wave packets, as earlier versions were; train it again")
    if state.get("rest") is not None:
        raise ValueError("it has a companion of an earlier version; train it again")
    if chosen is None:
        parameters = state["inner"]["model"]
        if "response.steering" in parameters and "response.delays" not in parameters:
            raise ValueError("its carrier phase is of splatted Gaussians, as in earlier versions; train anew")
        return {"inner": state["inner"], "init": state["inner"]["choices"]["init"]}
    kind = {"phase": "sources", "directions": "rays", "moving_array": "bearings"}[chosen]
    return {"inner": None, "field": {"kind": kind, "method": state["inner"]}, "init": kind}


def stored(field: ConditionalField) -> dict[str, Any]:
    """What `restored` reads."""
    if isinstance(field, StackedField):
        return {"members": [stored(member) for member in field.members], "weights": list(field.weights)}  # type: ignore[arg-type]
    if isinstance(field, CompletedField):
        parts = {"field": stored(field.field), "residual": stored(field.residual)}
        return {**parts, "weight": field.weight}
    return {"kind": field.kind, **field.state()}


def restored(site: Site, state: dict[str, Any]) -> ConditionalField:
    """The field whose `state()` this was."""
    if "members" in state:
        found: ConditionalField = StackedField(
            [restored(site, m) for m in state["members"]], state["weights"]
        )
    elif "residual" in state:
        field, residual = restored(site, state["field"]), restored(site, state["residual"])
        found = CompletedField(field, residual, float(state["weight"]))
    else:
        found = field_restored(str(state["kind"]))(site, state)
    found.site = site
    return found
