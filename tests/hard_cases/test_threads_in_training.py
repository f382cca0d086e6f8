"""Threads, in training: sums depend on the thread count.

Remedy: our operators have a fixed order of summation (test_threads.py); torch's own reductions have not, so a
run that must repeat pins its threads (`threads=1`). Shown: a pinned run repeats bit for bit.
"""

import torch
from campaigns import brief, compose, spectra

from gsparc.commands.train import train


def test_a_pinned_run_repeats(tmp_path):
    file = spectra(tmp_path / "own.npz")
    states = []
    for name in ("one", "two"):
        _, objects = train(compose(*brief(file)), tmp_path / name)
        states.append(objects.methods[0].fitted().state_dict())
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])
