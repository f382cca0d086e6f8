"""An interrupted run resumes after its finished searches."""

from __future__ import annotations

import pytest
import torch
from clocks import wound
from rooms import shoebox

from gsparc.models.image_sources import ensemble
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.training.context import FitContext

QUICK = {"searches": 2, "search_rows": 100, "margin": 2.0, "clutter": False}


def _fit(data, fold, folder, resume=None, clock="wall", **more):
    method = ImageSourceGP(**{**QUICK, **more})
    return method, method.fit(data, fold, FitContext(folder, resume=resume, budget_clock=clock))


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
        assert torch.equal(whole.predict(batch).mean, again.predict(batch).mean)
        before = torch.load(tmp_path / "cut" / "last.ckpt", weights_only=True)
        assert report.seconds > before["spent_s"] and report.limited_by is None
    finally:
        torch.set_num_threads(threads)


def test_seconds_of_the_wall_are_not_taken_off_a_budget_of_the_processor(tmp_path, monkeypatch):
    """A run that went on had less left, or nothing, where the machine had been busy."""
    clocks = wound(monkeypatch)
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    clocks.monotonic.wind(0.5)
    run = ensemble.Search.run
    monkeypatch.setattr(ensemble.Search, "run", lambda self: clocks.monotonic.wind(1000.0) or run(self))
    _fit(data, fold, tmp_path, searches=1, clock="processor", budget_s=20.0)
    stored = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert stored["spent_s"] > 999 and stored["processor_s"] < 1
    report = _fit(data, fold, tmp_path / "b", tmp_path / "last.ckpt", "processor", budget_s=20.0)[1]
    assert report.limited_by is None and report.seconds > 1999  # the second search, too


def test_what_a_hurried_search_found_is_the_machines_also_when_it_is_reused(tmp_path, monkeypatch):
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    run = ensemble.Search.run
    monkeypatch.setattr(ensemble.Search, "run", lambda self: (self.last_round(), run(self))[1])
    _fit(data, fold, tmp_path, searches=1, budget_s=1e-3)
    assert _fit(data, fold, tmp_path / "b", tmp_path / "last.ckpt", searches=1)[1].limited_by == "wall"


def test_searches_of_another_run_are_refused(tmp_path):
    _, data, fold = shoebox(60, size=(3.0, 2.5, 2.2), max_order=0)
    _fit(data, fold, tmp_path, searches=1)
    with pytest.raises(ValueError, match="is of other seed; start without it"):
        _fit(data, fold, tmp_path / "b", tmp_path / "last.ckpt", seed=5)
    (tmp_path / "last.ckpt").write_bytes(b"not a file of ours")
    with pytest.raises(ValueError, match="holds no finished searches"):
        _fit(data, fold, tmp_path / "c", tmp_path / "last.ckpt")
