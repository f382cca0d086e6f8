"""The same rows in another order, twice, or beside stations in another order are one answer.

Whatever is drawn, counted or averaged by rows asks for their content, not for their number
(`gsparc/data/row_order.py`). Tolerance: 1e-3 dB of powers,
1e-6 of the deviation of channels and spectra.
"""

import numpy as np
import pytest
from layouts import KINDS, POWERS, rows_of

import gsparc

ROWS = np.arange(60)
ORDERS = {
    "reversed": ROWS[::-1],
    "shuffled and twice": np.tile(np.random.default_rng(1).permutation(60), 2),
    "a third of them twice": np.r_[ROWS, ROWS[:20]],
}
TURNED = np.array([2, 0, 1])  # stations


def rearranged(kind: str, order: np.ndarray, stations: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of `rows_of` with rows and stations in another order."""
    arrays = {
        n.lstrip("_"): array if n[0] == "_" else array[order] for n, array in rows_of(kind).items()
    }
    for name, array in arrays.items():
        if name.startswith("station_") and array.ndim:
            arrays[name] = array[stations]
        elif name in ("rssi_db", "csi") and array.shape[1:2] == (3,):
            arrays[name] = array[:, stations]
    if "station" in arrays:
        arrays["station"] = np.argsort(stations)[arrays["station"]]
    return arrays


def answers(kind: str, order: np.ndarray, stations: np.ndarray = ROWS[:3]) -> np.ndarray:
    """What a model of these rows answers, (T, 9, ...) of T stations in the order of `rows_of`."""
    arrays, first = rearranged(kind, order, stations), rows_of(kind)
    given = {
        {"rx_position": "rx", "tx_position": "tx", "rssi_db": "rssi"}.get(n, n): a
        for n, a in arrays.items()
    }
    found = gsparc.fit(**given, effort=0.1, align="none" if "csi" in given else "auto")
    if kind == "degrees":
        asked = {
            "rx": np.c_[
                found.metres(first["latitude"][:9], first["longitude"][:9])[:, :2], np.ones(9)
            ]
        }
    else:
        asked = {
            end: first[f"{end}_position"][:9] + 0.1
            for end in ("rx", "tx")
            if f"{end}_position" in first
        }
    each = [found]
    if found.site.stations is not None:
        each = [found.select_station(int(one)) for one in np.argsort(stations)]
    what = ["rssi", "std"] if "rssi" in given else ["csi"] if "csi" in given else ["spectrum"]
    return np.stack([getattr(one, name)(**asked) for one in each for name in what])


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind not in POWERS)) for kind in KINDS]
)
def test_orders_and_copies_of_rows_and_orders_of_stations_are_one_answer(kind):
    once = answers(kind, ROWS)
    assert np.isfinite(once).all() and once.std() > 0
    least = 1e-3 if kind in POWERS else 1e-6 * once.std()
    for name, order in ORDERS.items():
        assert np.abs(answers(kind, order) - once).max() < least, name
    if any(name.startswith("_station_") for name in rows_of(kind)):
        assert np.abs(answers(kind, ROWS, TURNED) - once).max() < least, "stations"
