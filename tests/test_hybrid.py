"""What sources leave over is learned where it can be, and left alone where it cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import compose
from invented import invent
from rooms import nmse, rough, shoebox

from gsparc.array.tuning import LeftOut
from gsparc.coherent.vsgp import VirtualSourceGP
from gsparc.data.load import load
from gsparc.data.splits import Fold
from gsparc.hybrid import Beside, Rest, compared, learn_rest
from gsparc.peers.mean import Mean
from gsparc.registry import build

NONE = Fold(*[np.zeros(0, np.int64)] * 3)
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
    decision, rest = learn_rest("auto", Known(left), data, NONE)
    assert decision.on == diffuse
    if rest is not None:
        assert rest.gain > 0.8 and 0.5 < rest.weight <= 1
        assert Rest.restore(data.site, rest.state()).gain == rest.gain


@pytest.mark.slow
def test_diffuse_paths_are_left_to_a_process_and_it_is_stored(tmp_path):
    """Receivers .4 wavelengths apart, a third of the power from rough walls."""
    data, fold = rough(260)
    physics = _physics(data, fold)
    decision, rest = learn_rest("auto", physics, data, fold)
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
    decision, rest = learn_rest("auto", _physics(data, fold), data, fold)
    assert not decision.on and rest is None


def test_it_is_for_sources_with_carrier_phase():
    data = invent("csi")
    for switch, word in (("auto", "only sources"), (False, "as configured")):
        decision, rest = learn_rest(switch, Mean(), data, NONE)
        assert rest is None and not decision.on and word in decision.reason


@pytest.mark.parametrize(("off", "level"), [(0.01, False), (0.1, True), (0.5, True)])
def test_a_process_of_images_has_a_say_where_the_array_predicts_no_better(off, level):
    """Smooth images, and an array that is off by so much of their spread."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 1, (40, 3))
    images = np.sin(places @ rng.normal(size=(3, 30)) * 2) / 4 + 0.5
    centres, gaps = np.arange(0, 40, 2), np.array([0.0, 0.2])
    wrong = rng.normal(size=(2, 20, 30)) * off * images.std()
    behind, weight = compared(LeftOut(places, images, centres, gaps, images[centres] + wrong))
    assert (behind < 0.25) == level and (weight > 0.2) == level and (weight > 0.8) == (off == 0.5)


def test_an_array_of_few_spectra_answers_with_a_process_beside_it(tmp_path):
    data = load({"name": "rfid_sim", "count": 32, "root": str(tmp_path / "sim"), "seed": 0})
    rows = np.arange(32)
    fold = Fold(rows[rows % 2 > 0], rows[:0], rows[::2])
    settings = ["array_model.cache=false", "array_model.packets.samples=300", "effects.array=true"]
    method = build(compose(*(f"model.{s}" for s in settings), "model.effects.hybrid=true").model)
    method.fit(data, fold, tmp_path)
    array, beside = method.answering
    assert isinstance(beside, Beside) and 0 < beside.weight <= 1 and method.effects == "array+hybrid"
    batch = data.batch(fold.test)
    found = method.predict(batch.tx, batch.rx).mean
    parts = [m.predict(batch.tx, batch.rx).mean for m in (array, beside.process)]
    torch.testing.assert_close(found, torch.lerp(*parts, beside.weight), atol=1e-5, rtol=1e-5)
    again = build(compose().model)
    again.restore(data.site, method.state())
    torch.testing.assert_close(again.predict(batch.tx, batch.rx).mean, found, atol=1e-5, rtol=1e-5)
