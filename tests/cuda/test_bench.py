"""The stages of bench/gpu.py, run where there is no GPU: tensors stay here, the kernels are the shim's.

No figure means anything; what is proven is that the script ends and that its JSON holds what it promises.
"""

from __future__ import annotations

import json
import sys
import time
import types
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from shim import serving
from torch.overrides import TorchFunctionMode

from gsparc.ops import SphereGrid

BENCH = Path(__file__).parents[2] / "bench"


class Here(TorchFunctionMode):
    """What is asked for on `cuda` is made and left on this CPU."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if kwargs.get("device") == "cuda":
            kwargs["device"] = "cpu"
        if func is torch.Tensor.cuda:
            return args[0]
        moved = ("cpu" if isinstance(argument, str) and argument == "cuda" else argument for argument in args)
        return func(*moved, **kwargs)


class Event:
    def __init__(self, enable_timing: bool) -> None:
        self.at = 0.0

    def record(self) -> None:
        self.at = time.perf_counter()

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, other: Event) -> float:
        return 1e3 * (other.at - self.at)


class Graph:
    """Replays nothing."""

    def replay(self) -> None:
        pass


class Stream:
    def wait_stream(self, other: Stream) -> None:
        pass


@pytest.fixture
def measure(monkeypatch):
    """bench/measure.py on a small grid, without a GPU."""
    monkeypatch.syspath_prepend(str(BENCH))
    there = {
        **{"Event": Event, "CUDAGraph": Graph, "Stream": Stream, "current_stream": lambda *a: Stream()},
        **{"stream": lambda s: nullcontext(), "graph": lambda g: nullcontext(), "current_device": lambda: 0},
        **{"synchronize": lambda: None, "_sleep": lambda cycles: None},
        "get_device_properties": lambda device: types.SimpleNamespace(L2_cache_size=1024),
    }
    for name, value in there.items():
        monkeypatch.setattr(torch.cuda, name, value)
    import measure

    monkeypatch.setattr(measure, "GRID", SphereGrid.hemisphere(12, 24))
    monkeypatch.setattr(measure, "BATCHES", (1, 9))
    monkeypatch.setattr(
        measure, "kernel_ms", lambda call, **how: call() is not None and {"p50": 1.0, "p95": 2.0}
    )
    monkeypatch.setattr(measure, "cold_ms", lambda call: {"p50": 3.0, "p95": 4.0})
    for timer in ("event_ms", "wall_ms"):
        slow = getattr(measure, timer)
        monkeypatch.setattr(measure, timer, lambda call, slow=slow, **how: slow(call, rounds=2))
    with serving("shim"), Here():
        yield measure
    for name in ("measure", "record", "gpu"):
        sys.modules.pop(name, None)


LIMITS = {"copy_tb_s": 4.0, "float32_tflop_s": 50.0, "empty_launch_ms": 0.002}


def no_errors(section) -> None:
    assert "error" not in section, section
    for value in section.values():
        if isinstance(value, dict):
            no_errors(value)


def test_every_figure_is_a_ratio_to_the_device(measure):
    found = measure.pipeline(30, LIMITS)
    no_errors(found)
    kernels = ["plan", "forward", "plan_and_forward", "backward", "frozen_query"]
    ends = [f"end_to_end_{name}" for name in ("forward", "frozen", "graph", "forward_backward")]
    for name in [*kernels, *(f"{name}_cold" for name in kernels), *ends]:
        assert {"p50", "p95", "floor_ms", "bound_by", "ratio", "ratio_p95"} <= found[name].keys(), name
        assert found[name]["ratio"] == pytest.approx(found[name]["p50"] / found[name]["floor_ms"])


def test_frozen_batches(measure):
    found = measure.frozen(30, LIMITS)
    no_errors(found)
    for batch in measure.BATCHES:
        section = found[f"batch{batch}"]
        assert all(section[f"spectra_per_s{name}"] > 0 for name in ("", "_captured"))


def test_batches_and_networks(measure):
    no_errors(measure.many_poses(30, 2, LIMITS))
    no_errors(measure.emission(9, 3, LIMITS))


def test_json_survives_failing_stages(measure, tmp_path, capsys):
    import gpu

    file = tmp_path / "cuda.json"
    gpu.needs(file)
    gpu.update(file, n1000=gpu.guarded(lambda: measure.no_such_thing()))
    (tmp_path / "tests.log").write_text("3 passed, 1 failed in 2 s\n")
    gpu.note(file, "tests", "1", "7")
    facts = json.loads(file.read_text())
    assert "no attribute 'no_such_thing'" in facts["n1000"]["error"]
    assert facts["stages"]["tests"] == {"exit": 1, "seconds": 7, "said": ["3 passed, 1 failed in 2 s"]}
    gpu.table(file)
    assert "| tests.exit | 1 |" in capsys.readouterr().out


def test_similarity(measure):
    found = measure.similarity(2, LIMITS)
    no_errors(found)
    assert found["ratio"] > 0 and "end_to_end" in found
