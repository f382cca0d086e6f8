"""What people read of several fits of a method that chooses between models."""

from __future__ import annotations

import pytest

from gsparc.auto.auto_method import Auto, Member
from gsparc.methods.label import common_label
from gsparc.methods.registry import method_class


def chose(**weights: float) -> Auto:
    """As if it had been fitted."""
    method = Auto()
    method.members = tuple(Member(name, weight, 1.0) for name, weight in weights.items())
    return method


@pytest.mark.parametrize(
    "weights,label",
    [
        ({"gp": 1.0}, "auto (gp)"),
        ({"complex_gp": 0.7, "gsparc": 0.3}, "auto (complex_gp .7 + gsparc .3)"),
        ({"gp": 0.55, "idw": 0.45}, "auto (gp .55 + idw .45)"),
    ],
)
def test_a_mixture_is_named_with_its_weights(weights, label):
    assert chose(**weights).label == label and chose(**weights).name == "auto"
    assert Auto().label == "auto"


def test_several_fits_are_named_by_what_most_chose():
    one, other = chose(gp=1.0), chose(idw=1.0)
    assert common_label("auto", [one, one]) == "auto (gp)"
    assert common_label("auto", [one, one, other]) == "auto (gp in 2 of 3)"
    assert common_label("idw", [method_class("idw")()] * 2) == "idw"
    assert common_label("auto", []) == "auto"
