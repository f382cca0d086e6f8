"""What sources leave over is learned where it can be, and left alone where it cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import compose
from invented import invent
from rooms import nmse, rough, shoebox

from gsparc.coherent.vsgp import VirtualSourceGP
from gsparc.hybrid import Rest, learn_rest
from gsparc.peers.mean import Mean
from gsparc.registry import build

QUICK = {"searches": 1, "search_rows": 220, "margin": 4.0, "furniture": False, "edges": False}


def _physics(data, fold) -> VirtualSourceGP:
    method = VirtualSourceGP(**QUICK)
    method.fit(data, fold, Path())
    return method


class Known(VirtualSourceGP):
    """Sources that explain the direct path and nothing else."""

    def __init__(self, left) -> None:
        super().__init__()
        self.left = left

    def left_over(self):
        return np.arange(len(self.left)), self.left


@pytest.mark.parametrize("diffuse", [True, False])
def test_a_rest_of_waves_is_learned_and_one_of_noise_is_not(diffuse):
    """Receivers 0.3 wavelengths apart."""
    data, _ = rough(120, share=0.999, spacing=0.3)
    rng = np.random.default_rng(1)
    noise = torch.from_numpy(rng.normal(size=(120, 2))).float()
    left = torch.from_numpy(data.target[:, 0]) if diffuse else torch.view_as_complex(noise)[:, None]
    decision, rest = learn_rest("auto", Known(left), data)
    assert decision.on == diffuse
    if rest is not None:
        assert rest.gain > 0.8 and 0.5 < rest.weight <= 1
        assert Rest.restore(data.site, rest.state()).gain == rest.gain


@pytest.mark.slow
def test_diffuse_paths_are_left_to_a_process_and_it_is_stored(tmp_path):
    """Receivers .4 wavelengths apart, a third of the power from rough walls."""
    data, fold = rough(260)
    physics = _physics(data, fold)
    decision, rest = learn_rest("auto", physics, data)
    assert decision.on and "leave over" in decision.reason and 0.03 < rest.gain < 1
    batch = data.batch(fold.test)
    said, true = physics.predict(batch.tx, batch.rx).mean, batch.target.numpy()
    alone, together = (nmse(p.numpy(), true) for p in (said, said + rest.at(batch.rx.position)))
    assert together < 0.85 * alone
    method = build(compose("model.effects.phase=true", "model.effects.array=false").model)
    method.site, method._chosen, method._models["phase"], method._rest = data.site, "phase", physics, rest
    assert method.effects == "phase+hybrid"
    again = build(compose().model)
    again.restore(data.site, method.state())
    torch.testing.assert_close(
        again.predict(batch.tx, batch.rx).mean, said + rest.at(batch.rx.position), atol=1e-4, rtol=1e-4
    )


def test_where_sources_explain_everything_there_is_no_rest():
    _, data, fold = shoebox(150, size=(3.0, 2.5, 2.2), max_order=1)
    decision, rest = learn_rest("auto", _physics(data, fold), data)
    assert not decision.on and rest is None


def test_it_is_for_sources_with_carrier_phase():
    data = invent("csi")
    for switch, word in (("auto", "only sources"), (False, "as configured")):
        decision, rest = learn_rest(switch, Mean(), data)
        assert rest is None and not decision.on and word in decision.reason
