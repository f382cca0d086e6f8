"""What sources leave over is learned where it can be, and left alone where it cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import compose
from invented import invent
from rooms import directed, nmse, rough, shoebox

from gsparc.array.cross_validation import LeftOut, compared
from gsparc.auto.combine import (
    DirectionalEnsemble,
    ImageEnsemble,
    held_out_ratio,
    learn_companion,
    restored,
    weight_of,
)
from gsparc.data.load import load
from gsparc.data.splits import Fold
from gsparc.methods.mean import Mean
from gsparc.methods.method import FitContext
from gsparc.methods.method import LeftOut as LeaveOneOutResidual
from gsparc.methods.registry import build
from gsparc.multipath.image_source_gp import ImageSourceGP

NONE = Fold(*[np.zeros(0, np.int64)] * 3)
QUICK = {"searches": 1, "search_rows": 220, "margin": 4.0, "clutter": False, "edges": False}


def _physics(data, fold) -> ImageSourceGP:
    method = ImageSourceGP(**QUICK)
    method.fit(data, fold, FitContext(Path()))
    return method


class Known(ImageSourceGP):
    """Sources that explain the direct path and nothing else."""

    def __init__(self, left) -> None:
        super().__init__()
        self.left = left

    def leave_one_out(self):
        return LeaveOneOutResidual(np.arange(len(self.left)), self.left)


@pytest.mark.parametrize("diffuse", [True, False])
def test_a_rest_of_waves_is_learned_and_one_of_noise_is_not(diffuse):
    """Receivers 0.3 wavelengths apart."""
    data, _ = rough(120, share=0.999, spacing=0.3)
    rng = np.random.default_rng(1)
    noise = torch.from_numpy(rng.normal(size=(120, 2))).float()
    left = torch.from_numpy(data.target[:, 0]) if diffuse else torch.view_as_complex(noise)[:, None]
    decision, rest = learn_companion("auto", Known(left), data, NONE)
    assert decision.on == diffuse
    if rest is not None:
        assert rest.gain > 0.8 and 0.5 < rest.weight <= 1
        assert restored(data.site, rest.state()).gain == rest.gain


@pytest.mark.slow
def test_diffuse_paths_are_left_to_a_process_and_it_is_stored(tmp_path):
    """Receivers .4 wavelengths apart, a third of the power from rough walls."""
    data, fold = rough(260)
    physics = _physics(data, fold)
    decision, rest = learn_companion("auto", physics, data, fold)
    assert decision.on and "residual" in decision.reason and 0.03 < rest.gain < 1
    batch = data.batch(fold.test)
    said, true = physics.predict(batch.tx, batch.rx).mean, batch.target.numpy()
    added = rest.weight * rest.process.mean_at(batch.tx, batch.rx)
    alone, together = (nmse(p.numpy(), true) for p in (said, said + added))
    assert together < 0.85 * alone
    method = build(compose("model.effects.phase=true", "model.effects.array=false").model)
    method.site, method._chosen, method._companion = data.site, "phase", rest
    method._models["phase"] = physics
    assert method.effects == "phase+hybrid"
    again = build(compose().model)
    again.restore(data.site, method.state())
    torch.testing.assert_close(again.predict(batch.tx, batch.rx).mean, said + added, atol=1e-4, rtol=1e-4)


def test_where_sources_explain_everything_there_is_no_rest():
    _, data, fold = shoebox(150, size=(3.0, 2.5, 2.2), max_order=1)
    decision, rest = learn_companion("auto", _physics(data, fold), data, fold)
    assert not decision.on and rest is None


def test_it_is_for_sources_with_carrier_phase():
    data = invent("csi")
    for switch, word in (("auto", "only sources"), (False, "as configured")):
        decision, rest = learn_companion(switch, Mean(), data, NONE)
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
    settings = ["array_model.field.count=64", "effects.array=true"]
    method = build(compose(*(f"model.{s}" for s in settings), "model.effects.hybrid=true").model)
    method.fit(data, fold, FitContext(tmp_path))
    array, beside = method._models["array"], method._companion
    assert isinstance(beside, ImageEnsemble) and 0 < beside.weight <= 1 and method.effects == "array+hybrid"
    batch = data.batch(fold.test)
    found = method.predict(batch.tx, batch.rx).mean
    parts = [m.predict(batch.tx, batch.rx).mean for m in (array, beside.process)]
    torch.testing.assert_close(found, torch.lerp(*parts, beside.weight), atol=1e-5, rtol=1e-5)
    again = build(compose().model)
    again.restore(data.site, method.state())
    torch.testing.assert_close(again.predict(batch.tx, batch.rx).mean, found, atol=1e-5, rtol=1e-5)


SETTINGS = ["phase_model.searches=1", "phase_model.search_rows=220", "phase_model.clutter=false"]
SETTINGS += ["phase_model.edges=false", "phase_model.margin=4", "phase_probe.margin=4"]


def _best(*settings: str):
    return build(compose(*(f"model.{s}" for s in (*SETTINGS, *settings))).model)


def test_from_few_receivers_measured_directions_answer_alone():
    """A search of 16 channels finds what is not there; its own left-out error does not know."""
    data, _, _ = directed(80)
    rows = np.arange(80)
    fold = Fold(rows[:14], rows[14:16], rows[16:])
    method, batch = _best(), data.batch(fold.test)
    method.fit(data, fold, FitContext(Path()))
    assert method.effects == "directions" and method._chosen == "directions"
    assert nmse(method.predict(batch.tx, batch.rx).mean.numpy(), data.target[fold.test]) < 0.05
    other = _best()
    other.restore(data.site, method.state())
    assert torch.equal(other.predict(batch.tx, batch.rx).mean, method.predict(batch.tx, batch.rx).mean)


def test_an_interrupted_run_that_directions_answer_alone_goes_on(tmp_path):
    """It was refused with a sentence about recovered vectors."""
    data, _, _ = directed(80)
    rows = np.arange(80)
    method = _best("effects.phase=false", "effects.directions=true")
    context = FitContext(tmp_path, resume=tmp_path / "last.ckpt")
    method.fit(data, Fold(rows[:14], rows[14:16], rows[16:]), context)
    assert method.effects == "directions"


def test_searched_and_directed_sources_answer_together_where_both_know_something(monkeypatch):
    monkeypatch.setattr("gsparc.auto.combine.PROBE_S", float("inf"))  # all fifths, on however busy a machine
    data, fold, _ = directed(150, pillar=True)
    method, batch = _best("effects.phase=true"), data.batch(fold.test)
    method.fit(data, fold, FitContext(Path()))
    searched, rest = method._models["phase"], method._companion
    assert isinstance(rest, DirectionalEnsemble)
    assert method.effects.startswith("phase+directions") and 0 < rest.weight <= 1
    both = nmse(method.predict(batch.tx, batch.rx).mean.numpy(), data.target[fold.test])
    alone = [
        nmse(one.predict(batch.tx, batch.rx).mean.numpy(), data.target[fold.test])
        for one in (searched, rest.sources)
    ]
    assert both < 1.5 * min(alone) and both < 0.5 * max(alone)
    other = _best()
    other.restore(data.site, method.state())
    assert torch.equal(other.predict(batch.tx, batch.rx).mean, method.predict(batch.tx, batch.rx).mean)


@pytest.mark.parametrize("settings", [["effects.directions=false"], ["effects.phase=false"]])
def test_directions_are_not_used_where_they_are_not_wanted(settings):
    data, fold, _ = directed(40)
    method = _best(*settings, "phase_probe.budget_s=1")
    method.site = data.site
    decided = {d.effect: d for d in method._decide(data, fold, FitContext())}
    assert not decided["directions"].on


def test_a_promise_that_a_search_does_not_keep_costs_it_its_say():
    left = torch.randn(30, 1, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    told, searched = Known(left), Known(0.5 * left.flip(0))
    weights = [weight_of(told, searched, optimism) for optimism in (1.0, 4.0, 1e6)]  # type: ignore[arg-type]
    assert weights[0] < weights[1] < weights[2] and weights[2] > 0.99
    assert weight_of(told, Known(left[:20]), 1.0) == pytest.approx(0.5, abs=0.15)  # type: ignore[arg-type]


def test_searches_of_few_rows_promise_too_much():
    data, fold, _ = directed(150)
    few = fold.train[:10]
    probe = _best()._probe
    error, optimism, _ = held_out_ratio(probe, data, few, 0)
    better, honest, _ = held_out_ratio(probe, data, fold.train, 0)
    assert optimism > 2 and optimism > honest and error > 3 * better


def test_a_checkpoint_of_before_there_were_directions_still_loads():
    config = compose(*(f"model.{s}" for s in SETTINGS)).model
    del config.directional_model, config.effects.directions
    assert build(config).switches.directions == "auto"
