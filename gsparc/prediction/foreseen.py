"""What few rows can tell of levels before a training: the error they leave, and what more bring."""

from __future__ import annotations

import numpy as np

from gsparc.data.schema import Measurements
from gsparc.models.powers.members import foresee_errors
from gsparc.models.station_sites import station_site
from gsparc.models.target_rows import power_rows

MANY, FURTHER, LOOKED_AT = 60, 20, 6  # rows of a station from which on nothing is said; stations


def describe_few_rows(data: Measurements) -> str | None:
    """Return a sentence on levels of few rows of each station; None of other data, or of many.

    As in "with 12 rows about 5.7 dB at places between them; 20 more rows would bring 4.9 dB".
    """
    if not data.site.maps_levels:
        return None
    station = data.stations_of()
    count = np.bincount(station)
    number = np.flatnonzero(count)[:LOOKED_AT]
    if np.median(count[number]) > MANY:
        return None
    errors = []
    for of in number.tolist():
        rows = power_rows(data, np.flatnonzero(station == of))
        site = station_site(data.site, of) if data.site.several else data.site
        errors.append(foresee_errors(rows, site, FURTHER))
    now, later = np.sqrt(np.square(errors).mean(0))
    each = " a station" if data.site.several else ""
    rows_text = f"{np.median(count[number]):.0f} rows{each}"
    more = f"{FURTHER} more rows would bring {later:.2g} dB"
    return f"with {rows_text} about {now:.2g} dB at places between them; {more}"
