"""Rows arranged by moment: what every station's antennas heard at once."""

from dataclasses import replace

import numpy as np

from gsparc.data.moments import Snapshots
from gsparc.tables.own import from_arrays


def test_what_was_not_measured_counts_nowhere(csi_arrays):
    mask = np.ones((12, 2, 3), bool)
    mask[3, 0] = False
    data = from_arrays({**csi_arrays, "mask": mask})
    junk = replace(data, target=np.where(mask, data.target, np.complex64(7)))
    found = Snapshots.from_rows(junk, np.arange(12)).values
    assert (found[3, 0] == 0).all() and found[3, 1].all()
    assert np.array_equal(found, Snapshots.from_rows(data, np.arange(12)).values)
