"""Silent channel: NMSE, SNR and normalisation divide by 0 where nothing was received.

Remedy: scales of silence are defined, figures without a value are null and counted. Shown: a
campaign with silent rows, and one that is silent altogether, train and are tested with finite
figures, or are refused in one line. Exact. (Metrics alone: tests/evaluation/test_metrics.py.)
"""

import json
import math

import numpy as np
import pytest
from campaigns import STILL, brief, compose

from gsparc.commands.train import train


@pytest.mark.parametrize("kind", ["csi", "rssi", "spectrum"])
@pytest.mark.parametrize("silent", [0.3, 1.0])
def test_silence_is_learned_and_reported(tmp_path, kind, silent):
    rng = np.random.default_rng(0)
    rows = 40
    where = rng.uniform(0.5, 2.5, (rows, 3))
    quiet = rng.uniform(size=rows) < silent
    shape = {"csi": (rows,), "rssi": (rows,), "spectrum": (rows, 16, 32)}[kind]
    values = rng.uniform(0.2, 0.8, shape) * np.where(quiet, 0.0, 1.0).reshape(
        -1, *[1] * (len(shape) - 1)
    )
    extra = {"frequency_hz": 1e9} if kind == "csi" else {}
    values = values.astype(complex) if kind == "csi" else values
    file = tmp_path / "own.npz"
    np.savez(file, tx_position=where, rx_position=STILL, **{kind: values}, **extra)
    try:
        train(compose(*brief(file)), tmp_path / "run")
    except ValueError as refused:
        assert silent == 1.0 and "\n" not in str(refused) and str(file) in str(refused)
        return
    stored = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert all(v is None or isinstance(v, str) or math.isfinite(v) for v in stored.values())
