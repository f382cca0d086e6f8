"""What people read of several fits of a method that approximate differently."""

from __future__ import annotations

from types import SimpleNamespace

from gsparc.models.parts import common_label
from gsparc.models.registry import method_class


def test_several_fits_are_named_by_what_most_say():
    one, other = (SimpleNamespace(label=label) for label in ("gp (Vecchia 30)", "gp"))
    assert common_label("gp", [one, one]) == "gp (Vecchia 30)"
    assert common_label("gp", [one, one, other]) == "gp (Vecchia 30 in 2 of 3)"
    assert common_label("idw", [method_class("idw")()] * 2) == "idw"
    assert common_label("gp", []) == "gp"
