"""An interrupted run resumes after its finished searches."""

from __future__ import annotations

import pytest
import torch
from rooms import shoebox

from gsparc.methods.method import FitContext
from gsparc.multipath import ensemble
from gsparc.multipath.image_source_gp import ImageSourceGP

QUICK = {"searches": 2, "search_rows": 100, "margin": 2.0, "clutter": False, "edges": False}


def _fit(data, fold, folder, resume=None, **more):
    method = ImageSourceGP(**{**QUICK, **more})
    return method, method.fit(data, fold, FitContext(folder, resume=resume))


@pytest.fixture()
def counted(monkeypatch):
    """Seeds of the searches that were run; the search of a seed in `fatal` is interrupted."""
    begun, fatal, run = [], set(), ensemble.Search.run

    def watched(self):
        seed = self.generator.initial_seed()
        begun.append(seed)
        if seed in fatal:
            raise KeyboardInterrupt
        return run(self)

    monkeypatch.setattr(ensemble.Search, "run", watched)
    return begun, fatal


def test_finished_searches_are_reused(tmp_path, counted):
    begun, fatal = counted
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # one search after the other
    try:
        _, data, fold = shoebox(90, size=(3.0, 2.5, 2.2), max_order=0)
        whole, _ = _fit(data, fold, tmp_path / "whole")
        begun.clear()
        fatal.add(1)
        with pytest.raises(KeyboardInterrupt):
            _fit(data, fold, tmp_path / "cut")
        assert begun == [0, 1]
        begun.clear()
        fatal.clear()
        again, report = _fit(data, fold, tmp_path / "again", tmp_path / "cut" / "last.ckpt")
        assert begun == [1]
        batch = data.batch(fold.test)
        assert torch.equal(whole.predict(batch.tx, batch.rx).mean, again.predict(batch.tx, batch.rx).mean)
        assert report.seconds > torch.load(tmp_path / "cut" / "last.ckpt", weights_only=True)["spent_s"]
    finally:
        torch.set_num_threads(threads)


def test_searches_of_another_run_are_refused(tmp_path):
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    _fit(data, fold, tmp_path, searches=1)
    with pytest.raises(ValueError, match="is of other seed; start without it"):
        _fit(data, fold, tmp_path / "b", tmp_path / "last.ckpt", seed=5)
    (tmp_path / "last.ckpt").write_bytes(b"not a file of ours")
    with pytest.raises(ValueError, match="holds no finished searches"):
        _fit(data, fold, tmp_path / "c", tmp_path / "last.ckpt")
