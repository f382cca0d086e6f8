"""Channels of several runs, each with a phase of its own, and channels of which both ends move."""

import numpy as np
import pytest
import torch
from campaigns import compose
from worlds import World, arrays

from gsparc.commands.train import train
from gsparc.data.query import Query
from gsparc.datasets.load import split_for
from gsparc.evaluation.scores import score_methods, unseen_runs
from gsparc.models import loading
from gsparc.models.method import Method, Prediction
from gsparc.tables.own import from_arrays


@pytest.mark.slow
def test_runs_with_phases_of_their_own_were_weighed_without_them(tmp_path):
    """The default had 17 times the error of complex_gp, whose rows were the same."""
    world = World("tone", 5, 1, "rx", "metres", "none", "random", 300)
    np.savez(tmp_path / "own.npz", **arrays(world, 0))
    said = [
        "dataset=own",
        f"dataset.file='{tmp_path / 'own.npz'}'",
        "model=gsparc",
        "logger=none",
        "threads=1",
    ]
    facts, objects = train(compose(*said, "effort=.3", "baselines=[complex_gp]"), tmp_path / "run")
    assert facts["test/nmse"] < 1.1 * facts["baseline/complex_gp/nmse"] < 0.5
    data, method = objects.data, objects.methods[0]
    rows = objects.split.folds[0].test
    again, _ = loading.load(tmp_path / "run" / "model.ckpt")
    batch = data.batch(rows)
    assert torch.allclose(again.predict(batch).mean, method.predict(batch).mean, atol=1e-5)
    turned = method.predict(batch).mean / method.predict(Query(batch.tx, batch.rx)).mean
    # A phase for each run
    assert len(np.unique(np.round(np.angle(turned.flatten().numpy()), 3))) == 5


class Turned(Method):
    """The truth in a phase of its own."""

    name = "turned"

    def __init__(self, data, phase: float) -> None:
        self.data, self.phase = data, phase

    def predict(self, batch):
        return Prediction(self.data.targets(batch.index.numpy()) * np.exp(1j * self.phase))

    fit = state = restore = None  # type: ignore[assignment]


def test_runs_that_were_not_learned_from_are_scored_after_their_best_phase():
    data = from_arrays(arrays(World("tones", 5, 1, "tx", "metres", "masked", "runs", 300), 0))
    split = split_for({"name": "runs"}, data)
    fold = split.folds[0]
    assert len(unseen_runs(data, fold, "test")) == 1 and not len(unseen_runs(data, fold, "train"))
    method = Turned(data, 1.0)
    assert score_methods([method], data, split).figures()["nmse"] < 1e-10
    known = score_methods([method], data, split, "train").figures()["nmse"]
    # A known run's phase is to be known
    assert known == pytest.approx(abs(np.exp(1j) - 1) ** 2, rel=1e-4)
