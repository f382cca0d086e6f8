"""What stations elsewhere teach before any row: numbers of processes, as `stations.csv` has them.

The file has one line a public station, made by `python bench/station_numbers.py`. A kind of site
counts once however many stations it has: its median, then the median and the spread of kinds.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsparc.processes.fit_kernel import NumberPrior

FILE = Path(__file__).with_name("stations.csv")
NUMBERS = "length_share", "deviation_db", "noise_db"
LEAST_SPREAD = 0.5  # of a logarithm, and of an exponent: few kinds agree by chance


class Known(NamedTuple):
    """What is known before any row: mean and deviation of an exponent, and a process's numbers."""

    exponent: tuple[float, float]
    numbers: NumberPrior


@cache
def known_numbers(without: str = "") -> Known:
    """Return what stations of all kinds of site, but for one, teach.

    >>> 1 < known_numbers().numbers.deviation[0] < 20 and known_numbers().exponent[0] > 1
    True

    Args:
        without: the kind that is left out; empty: none.
    """
    kinds = defaultdict[str, list[list[float]]](list)
    with FILE.open(newline="") as lines:
        for line in csv.DictReader(lines):
            if line["kind"] != without:
                logs = [math.log(float(line[name])) for name in NUMBERS]
                kinds[line["kind"]].append([float(line["exponent"]), *logs])
    middles = np.array([np.median(stations, 0) for stations in kinds.values()])
    middle = np.median(middles, 0)
    squares = [((np.array(stations) - middle) ** 2).mean(0) for stations in kinds.values()]
    spread = np.sqrt(np.mean(squares, 0)).clip(LEAST_SPREAD)
    middle[1:] = np.exp(middle[1:])
    exponent, *numbers = zip(middle.tolist(), spread.tolist(), strict=True)
    return Known(exponent, NumberPrior(*numbers))
