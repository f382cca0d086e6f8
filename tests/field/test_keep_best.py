"""Steps that do not pay are not taken: the best validation is kept,
and training ends when none is better.
"""

from functools import partial

import numpy as np
import pytest
import torch
from campaigns import brief, compose, spectra
from contexts import loaded, short
from lightning.pytorch.callbacks import EarlyStopping

from gsparc.field.gradient_stage import LOOKS
from gsparc.field.keep_best import PATIENCE, _is_surely_less
from gsparc.models.registry import build
from gsparc.training.context import FitContext

COLD = ("init=sphere", "model.keep_best=true", "model.refit=false")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    # 10 of them for validation
    file = spectra(tmp_path_factory.mktemp("own") / "own.npz", rows=120)
    return file, *loaded(file)


def fitted(measured, folder, *more, steps=40, **context):
    file, data, fold = measured
    method = build(compose(*brief(file, *COLD, *more)).model).create_for(data)
    method.fit(data, fold, short(folder, steps, validate_every=5, **context))
    return method


def held_out(method, measured):
    _, data, fold = measured
    batch = data.batch(fold.val)
    return float((method.predict(batch).mean - batch.target).square().mean())


@pytest.mark.slow
def test_steps_that_pay_are_kept_and_a_resumed_run_keeps_the_same(measured, tmp_path):
    before = fitted(measured, tmp_path / "none", steps=1)
    whole = fitted(measured, tmp_path / "whole", every=10)
    assert whole.steps >= 10 and held_out(whole, measured) < 0.9 * held_out(before, measured)
    again = fitted(measured, tmp_path / "again", every=10, resume=tmp_path / "whole" / "last.ckpt")
    first, second = whole.fitted_model().state_dict(), again.fitted_model().state_dict()
    same = [np.allclose(a, second[key]) for key, a in first.items() if isinstance(a, torch.Tensor)]
    assert all(same) and again.steps == whole.steps


def test_steps_that_hurt_are_taken_back(measured, tmp_path, caplog):
    """A rate at which every step overshoots."""
    wild = ("init=images", "model.optimizer.emission=50.0")
    caplog.set_level("INFO")
    method = fitted(measured, tmp_path / "wild", *wild)
    start = fitted(
        measured, tmp_path / "start", "init=images", "model.steps=0", "model.refit=false"
    )
    assert method.steps == 0 and held_out(method, measured) < 1.1 * held_out(start, measured)
    assert "40 taken, none kept" in caplog.text  # keeping the best ends no training
    # `0 gradient steps changed ...` was said, too
    assert "changed the squared error" not in caplog.text


def test_steps_that_nobody_asked_for_end_after_looks_without_a_gain(measured, tmp_path, caplog):
    """Of 60 steps on real spectra none was kept, and they took more than half of the seconds."""
    caplog.set_level("INFO")
    _, data, fold = measured
    wild = "init=images", "model.keep_best=true", "model.optimizer.emission=50.0"
    method = build(compose(*brief(measured[0], *wild)).model).create_for(data)
    method.fit(data, fold, FitContext(tmp_path, batch_size=8))
    assert method.steps == 0 and method.steps_taken == PATIENCE * (60 // LOOKS)
    assert f"no significant gain in {PATIENCE} validations" in caplog.text


def test_no_steps_of_the_model_took_those_of_the_trainer(measured, tmp_path):
    """`model=array`, which is solved, took as many gradient steps as `trainer.max_steps` said."""
    assert fitted(measured, tmp_path, "init=images", "model.steps=0", steps=20).steps_taken == 0


@pytest.mark.parametrize("keep_best", [True, False])
def test_a_second_stage_asked_for_figures_it_has_not_and_took_more_steps(
    measured, tmp_path, keep_best
):
    """`callbacks=early_stopping` ended in an error;
    after `trainer.max_time` 391 of 281 steps were kept.
    """
    stop = partial(EarlyStopping, "val/error", min_delta=1.0, patience=2)  # the third look ends it
    more = ("init=images", "model.refit=true", f"model.keep_best={keep_best}")
    method = fitted(measured, tmp_path, *more, callbacks=lambda: [stop()])
    assert method.steps_taken == 15 and method.steps in ((0, 5, 10, 15) if keep_best else (15,))


@pytest.mark.parametrize(
    ("errors", "kept"),
    [([1, 1, 1, 0.9], False), ([0.9, 0.8, 0.9, 0.85], True), ([1.1, 1.0, 1.2, 1.1], False)],
)
def test_a_look_is_kept_where_its_rows_are_better_by_two_standard_errors(errors, kept):
    """One row of four that gains nothing but noise chose steps that cost the others."""
    start = torch.ones(4, dtype=torch.float64)
    assert _is_surely_less(torch.tensor(errors, dtype=torch.float64), start) == kept
