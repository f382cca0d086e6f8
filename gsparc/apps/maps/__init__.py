"""Maps of a trained model with calibrated intervals, where to measure next,
where to put a station.
"""

from gsparc.apps.maps.field_map import FieldMap
from gsparc.apps.maps.making import predict_map
from gsparc.apps.maps.placing import place_station
from gsparc.apps.maps.planning import plan_measurements

__all__ = ["FieldMap", "place_station", "plan_measurements", "predict_map"]
