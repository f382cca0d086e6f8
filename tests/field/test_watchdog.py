"""No phase of any fit computes for two seconds without looking at the clock and at interrupts."""

import pytest
import torch
from campaigns import channels, compose, powers, spectra
from kinds import moving_array, static_array
from watchdog import watched

from gsparc.data.load import load, split_for
from gsparc.evaluation.experiment.folds import context_of
from gsparc.models.registry import build

LONGEST_S = 2.0  # of the thread's own processor time: a busy machine does not lengthen it
KINDS = {  # what is measured, seconds, and overrides; as many rows as make the longest phase last
    "powers": (lambda folder: powers(folder / "own.npz", 1200), 3, ()),
    "channels": (lambda folder: channels(folder / "own.npz", 300, shape="S"), 5, ()),
    "channels of an array": (lambda folder: channels(folder / "own.npz", 150), 5, ()),
    "images": (lambda folder: spectra(folder / "own.npz", 100), 3, ()),
    "static array": (static_array, 3, ()),
    "moving array": (moving_array, 3, ()),
    "a search": (
        lambda folder: channels(folder / "own.npz", 300, shape="S"), 5, ("model=image_source_gp",),
    ),
}  # fmt: skip
EVERY = [pytest.param(kind, marks=() if kind == "powers" else pytest.mark.slow) for kind in KINDS]


@pytest.mark.parametrize("kind", EVERY)
def test_every_phase_looks_at_clock_and_interrupt(kind, tmp_path):
    """Of powers 26 s, of a wide room ten minutes went by: `budget_s=60` at 150 s and going."""
    make, budget_s, overrides = KINDS[kind]
    data = make(tmp_path)
    data = data if hasattr(data, "site") else load({"name": "own", "file": str(data)})
    config = compose("dataset=own", "dataset.file=x", f"budget_s={budget_s}", "logger=none", *overrides)
    method = build(config.model).made_for(data)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with watched() as looks:
            method.fit(
                data, split_for({"name": "random"}, data).folds[0], context_of(config, run_dir=tmp_path)
            )
    finally:
        torch.set_num_threads(threads)
    assert looks.clock[0] < LONGEST_S, looks.clock
    assert looks.interrupt[0] < LONGEST_S, looks.interrupt
