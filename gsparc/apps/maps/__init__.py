"""Maps of a trained model with calibrated intervals, where to measure next, where to put a station."""

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.making import map_of
from gsparc.apps.maps.placing import place_next
from gsparc.apps.maps.planning import plan_next

__all__ = ["FieldMap", "map_of", "place_next", "plan_next"]
