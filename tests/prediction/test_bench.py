"""The benchmark runs, counts its work rightly, and leaves finite numbers."""

import gc
import json

import pytest
import torch
from campaigns import compose

from gsparc.commands import bench
from gsparc.commands.bench import claims_table, page
from gsparc.ops import composite, machine_limits, make_plan
from gsparc.prediction.bench import kernels, layers
from gsparc.prediction.bench.claims import Claim
from gsparc.prediction.bench.measure import Case, Machine, Work, measure
from gsparc.prediction.bench.scene import receiver, scene
from gsparc.prediction.timing import ClockSettings


@pytest.mark.slow
def test_quick_bench_leaves_finite_ratios(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "run_directory", lambda: tmp_path)
    bench.task(compose("quick=true", config="bench"))
    gc.unfreeze()
    found = json.loads((tmp_path / "summary.json").read_text())
    ratios = [v for k, v in found.items() if k.endswith("/over_limit")]
    assert len(ratios) > 20 and all(0 < r < 1e6 for r in ratios)
    assert any(k.startswith("claim/") for k in found) and "Promises" in capsys.readouterr().out


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_pairs_are_the_pixels_inside_the_footprints(projection):
    """Counted again in plain PyTorch: a pixel counts where its alpha passes the cut-off."""
    field = scene(40, projection)
    plan = field.plan(receiver())
    alone = 0
    for i in range(40):
        one = [tensor[i : i + 1] for tensor in field.geometry]
        made = make_plan(*one, receiver(), plan.grid, projection=projection, backend="reference")
        alone += int((composite(made, *one, torch.ones(1, 1)).image > 0).sum())
    assert abs(machine_limits.pairs(plan) - alone) <= 2 + alone // 1000  # float32 at the edge


def test_a_case_is_divided_by_the_larger_of_its_bounds():
    clock = ClockSettings(rounds=3, least=3, warmup=1)
    pairs = Case("x", "-", 0, 1, Work(1, 10**7), kernel=lambda: machine_limits.exponentials(4))
    moved = Case("x", "-", 0, 1, Work(10**9, 1), kernel=lambda: None)
    assert measure(pairs, Machine(), 1, clock).bound == "pairs"
    row = measure(moved, Machine(), 1, clock)
    assert row.bound == "bytes" and row.over < 1


def test_a_claim_knows_its_direction():
    assert Claim("", 2.0, 3.0).met and not Claim("", 2.0, 3.0, True).met


def test_a_frozen_view_renders_what_the_plan_does():
    field = scene(60, "tangent")
    moving, frozen = kernels.moving(field, 1), kernels.frozen(field, 1)
    plan = field.plan(receiver())
    image = composite(plan, *field.geometry, field.features[None]).image
    assert moving.work.pairs > 1000 and moving.kernel().shape == frozen.kernel().shape == (1, 2, 90, 360)
    assert torch.allclose(image, frozen.kernel(), atol=1e-5)


def test_a_step_learns_with_either_backend():
    """Both contenders of the promise lower the same loss by the same layers."""
    case = layers.step("tangent", count=5, batch=2)
    assert case.reference is not None
    for call in (case.kernel, case.reference):
        losses = [call() for _ in range(6)]
        assert losses[-1] < losses[0]
    first = [
        float(call())
        for call in (layers.step("tangent", 5, 2).kernel, layers.step("tangent", 5, 2).reference)
    ]
    assert first[0] == pytest.approx(first[1], abs=1e-4)


def test_the_page_names_every_promise():
    facts = {"machine/cpu": "x", "machine/instruction_set": "y", "machine/cores": 2, "git": "abc"}
    facts |= {"machine/load": 0.5, "machine/load_before": 0.1}
    text = page(facts, [claims_table([("tangent", Claim("forward / limit", 4.0, 3.0))])])
    assert "| forward / limit | tangent | 4.00 | at most 3 | no |" in text and "abc" in text
