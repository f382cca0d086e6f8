"""What `model=gsparc` keeps in a checkpoint: fields made of fields."""

from __future__ import annotations

from typing import Any

from gsparc.data.schema import Site
from gsparc.models.fields import RESTORED
from gsparc.training.conditional import CompletedField, ConditionalField, StackedField


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
        found = RESTORED[str(state["kind"])](site, state)
    found.site = site
    return found
