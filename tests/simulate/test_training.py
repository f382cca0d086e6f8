"""`dataset=sionna` through the same door as every other: training, baselines, evaluation,
a stored model.
"""

from dataclasses import replace

import numpy as np
import pytest
from crashes import small_campaign

from gsparc.base.errors import DataError
from gsparc.datasets.load import load
from gsparc.datasets.sionna import with_true_targets
from gsparc.simulate.campaign import simulate

BOX = small_campaign(70)
SEARCH = [
    f"model.search.{setting}" for setting in ("sources=9", "rows=30", "candidates=1000", "steps=5")
]
ROAD = {"spectrum": ["experiment=sionna", *SEARCH], "csi": ["dataset=sionna", "model=complex_gp"]}


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    path = tmp_path_factory.mktemp("simulated") / "box.h5"
    simulate(BOX, path)
    return path


@pytest.mark.parametrize("kind", ROAD)
def test_fewer_effects_are_tested_on_the_full_simulation(kind, box, tmp_path):
    simulate(replace(BOX, effects=replace(BOX.effects, depth=0)), tmp_path / "los.h5")
    alone, whole = (
        load({"name": "sionna", "file": str(path), "target": kind})
        for path in (tmp_path / "los.h5", box)
    )
    config = {"name": "sionna", "file": str(tmp_path / "los.h5"), "target": kind, "truth": str(box)}
    data = load(config)
    train_rows, test_rows = data.release_split
    assert np.array_equal(data.target[train_rows], alone.target[train_rows])
    scale = [d.site.target_scale for d in (data, whole)]
    np.testing.assert_allclose(
        data.targets(test_rows) * scale[0], whole.targets(test_rows) * scale[1], rtol=1e-5
    )
    assert not np.array_equal(data.target[test_rows], alone.target[test_rows])
    assert len({data.site.sha256, alone.site.sha256, whole.site.sha256}) == 3
    assert load({**config, "truth": config["file"]}).site.sha256 == alone.site.sha256
    elsewhere = replace(whole, rx_position=whole.rx_position + 0.1)
    with pytest.raises(DataError, match="not the receivers or targets"):
        with_true_targets(alone, elsewhere, "dataset.truth=x")
    with pytest.raises(DataError, match="same test rows"):
        with_true_targets(alone, replace(whole, release_split=None), "dataset.truth=x")
