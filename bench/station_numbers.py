"""Numbers of processes at public stations: what few rows of a new one begin with.

python bench/station_numbers.py   # writes gsparc/models/powers/stations.csv: a minute of one core

A line a station: its kind of site, rows, extent, and the numbers of largest evidence of a law with
an exponential process, which hardly anything is known of before. Needs `../shared/data`.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pandas as pd
from cases import MEASURED, on_floor

from gsparc.models.powers import known_numbers, members
from gsparc.models.target_rows import power_rows
from gsparc.processes.fit_kernel import LOOKS, NumberPrior
from gsparc.processes.kernel import ExponentialShadowing
from gsparc.processes.powers import condition_on_powers
from gsparc.tables.own import from_arrays

VAGUE = NumberPrior((0.2, 3.0), (6.0, 3.0), (2.0, 3.0))
ROWS, EACH = 300, 12  # of a station; stations of a kind
METRES = 111_320.0  # of a degree of latitude


class Station(NamedTuple):
    """A station: its kind of site and name, places (n, 3) [m], levels (n,) [dB], its place (3,)."""

    kind: str
    name: str
    places: np.ndarray
    levels: np.ndarray
    still: np.ndarray | None


def stations() -> Iterator[Station]:
    """Yield stations of `../shared/data`."""
    cells = pd.read_csv(MEASURED / "cbrs/cells.csv").set_index("cell")
    rows = pd.read_csv(MEASURED / "cbrs/mast1.csv")
    east = (rows.longitude - cells.lon.iloc[0]) * METRES * np.cos(np.radians(cells.lat.iloc[0]))
    rows["x"], rows["y"] = east, (rows.latitude - cells.lat.iloc[0]) * METRES
    for (cell, device), part in rows.groupby(["PCI", "device"]):
        place = on_floor(part[["x", "y"]].to_numpy())
        yield Station(
            "campus", f"{cell} {device}", place, part.rsrp.to_numpy(), np.array([0, 0, 20.0])
        )
    city = np.load(MEASURED / "real/powder-rss-462mhz.npz", allow_pickle=False)
    for number, place in enumerate(city["station_position"]):
        moving, level = on_floor(city["mobile_position"]), city["rssi_db"][:, number]
        yield Station("city", str(number), moving, level, np.append(place, 10.0))
    for hall in (1, 2):
        npz = np.load(MEASURED / f"real/ble-hall-{hall}.npz", allow_pickle=False)
        for number, place in enumerate(npz["station_position"]):
            level = npz["rssi_db"][:, number]
            yield Station("hall", f"{hall} {number}", npz["mobile_position"], level, place)
    robots = np.load(MEASURED / "both-ends/robots.npz", allow_pickle=False)
    for number in range(0, 73, 73 // EACH):
        part = robots["tx_place"] == number
        place, level = robots["rx_position"][part], robots["rssi_db"][part]
        yield Station("floor", str(number), place, level, robots["tx_position"][part][0])
    for name in ("rss-lib1", "rss-tut3", "wifine-floor4"):
        npz = np.load(MEASURED / f"locate/{name}.npz", allow_pickle=False)
        heard = np.argsort(-np.isfinite(npz["rss_dbm"]).sum(0))[: EACH // 2]
        for number in heard:
            yield Station(
                "building", f"{name} {number}", npz["position"], npz["rss_dbm"][:, number], None
            )
    garage = np.load(MEASURED / "change/garage-rounds.npz", allow_pickle=False)
    first = garage["round"] == 1
    for number in range(0, garage["rss_dbm"].shape[1], 3):
        place = on_floor(garage["position"][first][:, :2])
        yield Station("garage", str(number), place, garage["rss_dbm"][first, number], None)


def main() -> None:
    """Write the file."""
    with known_numbers.FILE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        head = ("kind", "station", "rows", "extent_m", "exponent", *known_numbers.NUMBERS)
        writer.writerow(head)
        for station in stations():
            heard = np.flatnonzero(np.isfinite(station.levels))
            heard = np.random.default_rng(0).permutation(heard)[:ROWS]
            if len(heard) < members.PLACE_NEEDS:
                continue
            arrays = {"rx_position": station.places[heard], "rssi_db": station.levels[heard]}
            arrays |= {} if station.still is None else {"tx_position": station.still}
            data = from_arrays(arrays, {"name": station.kind})
            rows = power_rows(data, np.arange(len(data)))
            extent = members.extent_of(rows)
            law = members.means(rows, data.site, ())[0]
            kernel = VAGUE.start(extent, ExponentialShadowing)
            member = members.PowerMember(law.trend, 1.0, kernel)
            member = members.fit_member_kernel(rows, member, VAGUE, extent, 3 * LOOKS)
            exponent = members.exponent_of(condition_on_powers(rows, member.prior, 0)[0])
            kernel = member.kernel
            noise = kernel.amplitude * kernel.noise
            numbers = kernel.length / extent, kernel.amplitude**0.5, noise**0.5
            line = station.kind, station.name, len(data), extent, exponent, *numbers
            writer.writerow([f"{v:.4g}" if isinstance(v, float) else v for v in line])
            sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main()
