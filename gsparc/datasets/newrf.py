"""Rooms of NeWRF: one transmitter, many receivers, one complex channel each.

The release is a pickled pandas table of a row per receiver: TxPos, RxPos (3,) [m]; CSI (1,)
complex; Frequency [GHz]; LastXPts (3, P) [m] and RxChanPerRay (P, 1), of P paths each; LineOfSight.

The same as an npz: tx_pos (3,), rx_pos (S, 3) [m]; csi (S,) or (S, K) complex; frequency_hz () or
(K,) [Hz]; optional: path_offsets (S + 1,), path_last_point (P, 3) [m], path_gain (P,);
line_of_sight (S,); split_train, split_test.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsparc.base.errors import DataError, readable
from gsparc.base.pickles import read_pickled_frame
from gsparc.datasets.campaign import Campaign
from gsparc.tables.arrays import Raw, rename_arrays
from gsparc.tables.raw import read_raw

NAMES = {"tx_pos": "tx_position", "rx_pos": "rx_position"}
COLUMNS = ("TxPos", "RxPos", "CSI", "Frequency", "LastXPts", "RxChanPerRay", "LineOfSight")


def read_newrf(path: str | Path) -> Raw:
    """Read a room of the release, or an npz, under the schema's names.

    Raises:
        DataError: no such file, or arrays are missing, each in a line.
    """
    path = Path(path)
    raw = Raw(_of_release(path)) if path.suffix.lower() in NeWRF.suffixes else read_raw(path)
    missing = [name for name in (*NAMES, "csi", "frequency_hz") if name not in raw.arrays]
    if missing:
        raise DataError(
            [f"{path}, {n}: missing; expected in the layout of NeWRF" for n in missing], path
        )
    return rename_arrays(raw, NAMES)


def _of_release(path: Path) -> dict[str, np.ndarray]:
    """The npz's arrays; rows with a value that is missing are left out, as the makers do."""
    frame = read_pickled_frame(path)
    missing = [name for name in COLUMNS if name not in frame]
    if missing:
        raise DataError(
            f"{path}: no columns {', '.join(missing)}; it holds {', '.join(map(str, frame))}"
        )
    whole = [
        i for i in range(len(frame["CSI"])) if all(_finite(frame[name][i]) for name in COLUMNS)
    ]
    with readable(path, "not the table of a room", (ValueError, TypeError)):
        rows = {name: [np.asarray(frame[name][i]) for i in whole] for name in COLUMNS}
        arrays = {
            "tx_pos": np.stack(rows["TxPos"]).astype(np.float64),
            "rx_pos": np.stack(rows["RxPos"]).astype(np.float64),
            "csi": np.concatenate([csi.ravel() for csi in rows["CSI"]]).astype(np.complex64),
            "frequency_hz": np.unique(np.array(rows["Frequency"], np.float64) * 1e9),
            "path_offsets": np.cumsum([0, *(gain.size for gain in rows["RxChanPerRay"])]),
            "path_last_point": np.concatenate(rows["LastXPts"], axis=1).T.astype(np.float32),
            "path_gain": np.concatenate([g.ravel() for g in rows["RxChanPerRay"]]).astype(
                np.complex64
            ),
            "line_of_sight": np.array(rows["LineOfSight"]) != 0,
        }
    if len(arrays["frequency_hz"]) != 1 or (arrays["tx_pos"] != arrays["tx_pos"][0]).any():
        raise DataError(
            f"{path}: several transmitters or frequencies; expected one of each in a room"
        )
    arrays |= {"tx_pos": arrays["tx_pos"][0], "frequency_hz": arrays["frequency_hz"][0]}
    return arrays


def _finite(value: object) -> bool:
    numbers = np.asarray(value)
    return numbers.dtype.kind in "fciub" and numbers.size > 0 and bool(np.isfinite(numbers).all())


class NeWRF(Campaign):
    """One transmitter, many receivers, complex channels; settings of `Campaign`."""

    choice, reader = "newrf", staticmethod(read_newrf)
    marks, suffixes = frozenset({*NAMES, "csi", "frequency_hz"}), (".pkl", ".pickle")
