"""The kernels that are timed compute what their references do, and the command leaves one table."""

import json
import re

import pytest
import torch
from campaigns import compose

from gsparc.base.limits import SettingError
from gsparc.commands import bench
from gsparc.ops import cuda_library
from gsparc.ops.backends import BackendUnavailable
from gsparc.prediction import bench as timed
from gsparc.prediction.bench import kernel_cases, loss_case, training_step_case


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Batches of two: plain PyTorch is slow."""
    monkeypatch.setattr(timed, "BATCH", 2)


@pytest.mark.parametrize("projection", ["tangent", "equirect"])
def test_kernels_compute_what_their_references_do(projection):
    for case in [
        *kernel_cases(30, projection),
        loss_case(),
        training_step_case(projection, count=5),
    ]:
        kernel, reference = case.kernel(), case.reference()
        if case.name == "plan":
            assert torch.equal(kernel.visible, reference.visible)
            continue
        pairs = (
            zip(kernel, reference, strict=True)
            if isinstance(kernel, tuple)
            else [(kernel, reference)]
        )
        # The loss of plain PyTorch is another mean: 16 spectra are summed here, averaged there.
        for ours, theirs in () if case.name == "loss of spectra" else pairs:
            assert torch.allclose(ours, theirs.to(ours.dtype), rtol=1e-3, atol=1e-3), case.name


@pytest.mark.slow
def test_the_table_has_a_ratio_where_there_is_a_reference(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "run_directory", lambda: tmp_path)
    monkeypatch.setattr(
        bench,
        "training_step_case",
        lambda projection, device: training_step_case(projection, count=5, device=device),
    )
    bench.task(
        compose("counts=[20]", "projections=[tangent]", "rounds=2", "rounds_s=0", config="bench")
    )
    facts = json.loads((tmp_path / "summary.json").read_text())
    seconds = {name: value for name, value in facts.items() if name.startswith("bench/")}
    assert len(seconds) == 7 and min(seconds.values()) > 0
    # "times" is on the line above where numbers are long
    assert "faster" in capsys.readouterr().out
    assert (tmp_path / "bench.csv").read_text().count("\n") == 8


def test_a_device_that_is_not_here_says_why():
    reason = cuda_library.missing_device()
    if reason is None:
        pytest.skip("there is a GPU here")
    with pytest.raises(BackendUnavailable, match=re.escape(reason)):
        bench.task(compose("counts=[20]", "device=cuda", config="bench"))


def test_another_device_is_no_traceback():
    """`device=reference` is a backend's name, and no device."""
    with pytest.raises(SettingError, match="device='reference': one of cpu, cuda is needed"):
        bench.task(compose("counts=[20]", "device=reference", config="bench"))
