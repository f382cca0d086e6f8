"""`gsparc check` reads the files of campaigns as their loaders do; `dataset=own` says whose they are."""

from __future__ import annotations

import numpy as np
import pytest
from releases import real

from gsparc.data.datasets.own import read_any
from gsparc.data.errors import DataError
from gsparc.data.load import load

FILES = {
    "techtile-csi-920mhz.npz": "techtile", "powder-rss-462mhz.npz": "powder", "ble-hall-1.npz": "ble",
    "ble-hall-2.npz": "ble", "techtile-power-reci-rf-1.npz": None,
}  # fmt: skip


@pytest.mark.parametrize(("file", "campaign"), FILES.items())
def test_check_reads_a_campaign_as_its_loader_does(file, campaign):
    path = real(f"real/{file}")
    reading = read_any(path)
    assert any(f"dataset={campaign}" in note for note in reading.notes) == (campaign is not None)
    loaded = load({"name": campaign or "own", "file": str(path)})
    assert reading.data.site.sha256 == loaded.site.sha256


def test_own_names_the_campaign_of_a_file(tmp_path):
    file = tmp_path / "hall.npz"
    np.savez(file, mobile_position=np.eye(3), station_position=np.eye(3), rssi_db=np.zeros((3, 3)))
    with pytest.raises(DataError, match="this is a file of dataset=ble; say dataset=ble"):
        load({"name": "own", "file": str(file)})
