"""Rows of a station that are another one's of the same name, far off, are named and left out."""

import numpy as np
import pandas as pd
import pytest
from releases import real

from gsparc.data.foreign import find_foreign, find_foreign_patches, foreign_warnings
from gsparc.datasets.load import load, split_for
from gsparc.models.powers.together.network import check_azimuths


def campus(folder, stranger):
    """Cells A, C and D of a mast; of C a thousand more rows 2 km off where it is strong."""
    rows = pd.read_csv(real("cbrs/mast1.csv")).query("PCI != 'B'")
    rng = np.random.default_rng(0)
    level = np.round(rng.normal(-63, 6, 1000))
    patch = pd.DataFrame({"PCI": "C", "device": "Pixel", "rsrp": level})
    patch["latitude"] = 35.988 + rng.uniform(0, 2e-3, 1000)
    patch["longitude"] = -78.957 + rng.uniform(0, 2e-3, 1000)
    pd.concat([rows, patch] if stranger else [rows]).to_csv(folder / "drive.csv", index=False)
    listed = str(real("cbrs/cells.csv"))
    return load({"name": "own", "file": str(folder / "drive.csv"), "stations_file": listed})


def test_an_identity_that_is_used_again_elsewhere_is_named_and_left_out(tmp_path):
    """1,087 rows 2 km off at -63 dBm were learned from, and turned an azimuth by 40 degrees."""
    clean, mixed = campus(tmp_path, False), campus(tmp_path, True)
    assert find_foreign(clean) == {} and foreign_warnings(clean) == []
    (number,) = find_foreign(mixed)
    (rows,) = find_foreign(mixed)[number]
    assert mixed.site.every_station.shown[number] == "C" and len(rows) == len(mixed) - len(clean)
    (text,) = foreign_warnings(mixed)
    assert f"C, 1856 m away ({len(rows)} rows: lines 18702 to" in text
    assert text.endswith("split.leave_out=foreign leaves them out")
    fold = split_for({"name": "random", "leave_out": "foreign"}, mixed).folds[0]
    assert not np.isin(np.concatenate([fold.train, fold.val, fold.test]), rows).any()
    assert [len(part) for part in vars(fold).values()] == [
        len(part) for part in vars(split_for({"name": "random"}, clean).folds[0]).values()
    ]
    # It says nothing of where C looks
    turned = [[t for t in check_azimuths(data) if "contradicted" in t] for data in (clean, mixed)]
    assert turned[0] == turned[1]


@pytest.mark.parametrize("exponent", [2.5, 4.0])
def test_a_second_street_of_the_same_station_is_its_own(exponent):
    """Far places behind a gap are weak as far ones are, whatever their shadows."""
    rng = np.random.default_rng(1)
    near, far = rng.uniform(-300, 300, (400, 2)), rng.uniform((1500, 900), (1600, 1000), (100, 2))
    places = np.r_[near, far]
    distance = np.maximum(np.linalg.norm(places, axis=1), 20)
    level = -30 - 10 * exponent * np.log10(distance) + rng.normal(0, 8, 500)
    assert find_foreign_patches(places, level, np.zeros(2)) == []
    level[400:] += 60
    (patch,) = find_foreign_patches(places, level, np.zeros(2))
    assert np.array_equal(patch, np.arange(400, 500))
    assert find_foreign_patches(places, level, np.full(2, np.nan)) == []
