"""What `prices` and `sensitivity` compare: every variant under the trainer that was asked for."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from campaigns import compose
from hydra.core.hydra_config import HydraConfig

from gsparc.simulate.rfid_sim import ensure_rfid_sim
from gsparc.studies.study.variants import setting


@pytest.mark.parametrize("model", ["gsparc", "moving_array"])
def test_every_method_that_takes_a_budget_gets_it(model, tmp_path, monkeypatch):
    """Only splatted fields and what is made of them did: `budget_s` was not heard by the others."""
    here = SimpleNamespace(runtime=SimpleNamespace(output_dir=tmp_path))
    monkeypatch.setattr(HydraConfig, "get", lambda: here)
    root = ensure_rfid_sim(tmp_path, count=20, seed=0)
    config = compose(
        f"dataset.root='{root}'", f"model={model}", "budget_s=7", "seed=5",
        "~variants", "+variants={as_it_is: {}}", "rivals=[mean]", config="prices",
    )  # fmt: skip
    found = setting(config)
    assert found.context.budget_s == 7 and found.context.seed == 5
    assert set(found.makers) == {"as_it_is", "mean"} and len(found.data) == 20
