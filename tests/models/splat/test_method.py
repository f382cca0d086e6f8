import copy

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, spectra
from contexts import short
from scenes import fold_of

from gsparc.data.query import Query
from gsparc.datasets.load import load as load_data
from gsparc.models.registry import build
from gsparc.models.splat import method as splatting
from gsparc.models.splat.method import LearnedField
from gsparc.ops import Pose


def learned(file, *more: str) -> LearnedField:
    return build(compose(*brief(file, *more)).model).create_for(
        load_data({"name": "own", "file": str(file)})
    )


def fitted(file, run_dir, *more: str, steps: int = 15, every: int | None = None):
    data = load_data({"name": "own", "file": str(file)})
    fold = fold_of(data)
    method = learned(file, *more)
    method.fit(data, fold, short(run_dir, steps, every=every, validate_every=10))
    return method, data, fold


@pytest.mark.parametrize("height,width", [(1, 8), (8, 1), (7, 13)])
@pytest.mark.parametrize("more", [(), ("init=sphere",)], ids=["closed form", "steps"])
def test_images_smaller_than_the_window_of_ssim_train(tmp_path, caplog, height, width, more):
    with np.load(spectra(tmp_path / "own.npz")) as stored:
        arrays = {**stored, "spectrum": stored["spectrum"][:, :height, :width]}
    np.savez(tmp_path / "own.npz", **arrays)
    caplog.set_level("INFO")
    method, data, fold = fitted(tmp_path / "own.npz", tmp_path, *more)
    assert "smaller than SSIM's window" in caplog.text
    batch = data.batch(fold.test)
    assert torch.isfinite(method.predict(batch).mean).all()


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A field before a receiver that stands, and what it learned from."""
    folder = tmp_path_factory.mktemp("still")
    return fitted(spectra(folder / "own.npz"), folder)[:2]


def test_a_static_receiver_is_frozen_and_another_pose_and_an_edit_are_seen(still):
    method, data = still
    batch = data.batch(np.arange(4))
    quick = method.predict(batch).mean
    slow = method.fitted_model()(batch.tx, batch.rx).mean.clamp(0, 1).detach()
    assert torch.allclose(quick, slow, atol=1e-5)
    moved = Pose(batch.rx.position + 0.5, batch.rx.rotation)
    assert not torch.allclose(method.predict(Query(batch.tx, moved)).mean, quick, atol=1e-3)
    edited = copy.deepcopy(method)
    with torch.no_grad():
        edited.fitted_model().gaussians.opacity_logits.fill_(-9.0)
        edited.fitted_model().gaussians.version += 1
    assert edited.predict(batch).mean.sum() < 0.1 * quick.sum()


@pytest.mark.parametrize("cut", ["last.ckpt", "refit/last.ckpt"])
def test_a_run_on_a_single_tone_can_be_resumed(tmp_path, cut):
    """`loaded state dict has a different number of parameter groups`:
    its delays are not learned.
    """
    file = channels(tmp_path / "own.npz", shape="S")
    method, data, fold = fitted(file, tmp_path, every=5)
    resumed = learned(file)
    context = short(tmp_path / "on", 15, every=5, validate_every=10, resume=tmp_path / cut)
    resumed.fit(data, fold, context)
    before, after = method.fitted_model().state_dict(), resumed.fitted_model().state_dict()
    assert all(torch.equal(before[key], after[key]) for key in before)


@pytest.mark.parametrize("start", ["auto", "sphere"])
def test_refit_learns_from_validation_rows_too_and_keeps_a_learned_confidence(tmp_path, start):
    file = spectra(tmp_path / "own.npz")
    seen = {}
    for refit in ("false", "true"):
        method, data, fold = fitted(file, tmp_path / refit, f"model.refit={refit}", f"init={start}")
        batch = data.batch(fold.val)
        said = method.predict(batch)
        seen[refit] = float((said.mean - batch.target).square().mean()), said.confidence
    if start == "auto":  # what is unknown in closed form is known of these rows after
        assert (
            seen["true"][0] < 0.8 * seen["false"][0] and (seen["true"][1] > seen["false"][1]).all()
        )
    else:
        assert torch.equal(seen["true"][1], seen["false"][1])


def test_a_closed_form_start_that_cannot_be_says_what_it_needs(tmp_path):
    with pytest.raises(ValueError, match="needs spectra, a static receiver"):
        fitted(channels(tmp_path / "own.npz"), tmp_path, "init=images")


def test_few_validation_rows_chose_steps(tmp_path):
    """Two rows tell by chance: a closed-form start is the answer,
    a field of steps has a third held out.
    """
    file = spectra(tmp_path / "own.npz", rows=30)
    method, _, fold = fitted(file, tmp_path, "model.keep_best=true")
    assert len(fold.val) < 8 and method.steps == 0
    moving = spectra(tmp_path / "own.npz", rows=30, moving="rx")
    data = load_data({"name": "own", "file": str(moving)})
    few = fold_of(data)
    told = splatting._hold_out_third(data, few, short(tmp_path, 5))
    assert len(few.val) < 4 <= len(told.val) and np.array_equal(told.test, few.test)
    assert set(told.train) | set(told.val) == set(few.train) | set(few.val)
