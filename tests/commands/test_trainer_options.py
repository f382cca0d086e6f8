"""What may be asked of a run besides a model: options of the Trainer, weights to start from, an objective."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, spectra
from lightning.pytorch import Trainer

import gsparc
from gsparc.commands import train as command
from gsparc.commands.train import objective_of, train
from gsparc.data.datamodule import Loaded
from gsparc.data.load import datamodule
from gsparc.data.splits import Fold
from gsparc.evaluation.console import one_line
from gsparc.evaluation.metric_formats import DECIDING, lower_is_better, score_of
from gsparc.evaluation.metrics import figure_names
from gsparc.models import checkpoint
from gsparc.models.loading import module_of

STILL = [f"model.optimizer.{name}=0" for name in ("positions", "positions_final", "scales", "rotations",
         "opacities", "emission", "confidence", "gain")]  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return spectra(tmp_path_factory.mktemp("own") / "own.npz")


@pytest.fixture(scope="module")
def trained(file, tmp_path_factory):
    """A finished model and a training state of step 15 of 20."""
    more = ("model.refit=false", "callbacks.checkpoint.every_n_train_steps=15")
    _, objects = train(compose(*brief(file, *more)), tmp_path_factory.mktemp("trained"))
    return objects.checkpoints[0]


def weights(path) -> dict[str, torch.Tensor]:
    return checkpoint.read(path).state["inner"]["model"]


# -- options of the Trainer ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        ["trainer=debug"],
        ["trainer.precision=bf16-mixed"],
        ["trainer.gradient_clip_val=1.0", "trainer.val_check_interval=7"],
        ["+trainer.profiler=simple"],
    ],
)
def test_an_option_of_the_trainer_is_an_override(options, file, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    facts, _ = train(compose(*brief(file, "model.refit=false", *options)), tmp_path)
    assert np.isfinite(facts["test/psnr_db"]) and facts["test/psnr_db"] > 20
    curve = (tmp_path / "learning_curve.csv").read_text().splitlines()[1:]
    steps = [int(row.split(",")[0]) for row in curve]
    assert steps == {"trainer=debug": [1], "trainer.gradient_clip_val=1.0": [7, 14]}.get(options[0], [10, 20])
    assert ("FIT Profiler Report" in caplog.text) == (options[0] == "+trainer.profiler=simple")


def test_checkpoints_come_when_asked_for_and_go_on_bit_identically(file, trained, tmp_path):
    last = trained.parent / "last.ckpt"
    assert checkpoint.read(last).extra["trainer"]["global_step"] == 15
    again = brief(file, "model.refit=false", f"ckpt_path='{last}'")
    _, objects = train(compose(*again), tmp_path)
    whole, resumed = weights(trained), weights(objects.checkpoints[0])
    assert whole.keys() == resumed.keys() and all(torch.equal(whole[k], resumed[k]) for k in whole)


def test_several_devices_need_a_strategy_of_processes_that_end(file, tmp_path):
    with pytest.raises(ValueError, match="say trainer=ddp"):
        train(compose(*brief(file, "trainer.devices=2")), tmp_path)


@pytest.mark.slow
def test_two_devices_learn_what_one_does(file, trained, tmp_path):
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "model.refit=false"]
    facts, objects = train(compose(*brief(file, *two)), tmp_path)
    rows = (tmp_path / "learning_curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", "10", "20"]  # written by one of them
    assert facts["time/train_s"] > 0
    one, both = weights(trained)["gaussians.means"], weights(objects.checkpoints[0])["gaussians.means"]
    start = compose(*brief(file, "trainer.max_steps=1", "model.refit=false", *STILL))
    _, untouched = train(start, tmp_path / "start")
    began = weights(untouched.checkpoints[0])["gaussians.means"]
    assert (both - one).norm() < 0.2 * (one - began).norm()  # the same mean gradient, but for rounding


def test_tensorboard_that_is_not_there_is_one_line(file, tmp_path, monkeypatch):
    def absent(*unused, **named):
        raise ModuleNotFoundError("No module named 'tensorboard'")

    monkeypatch.setattr("lightning.pytorch.loggers.TensorBoardLogger", absent)
    config = compose(*brief(file), "logger=tensorboard", f"logger.csv.save_dir='{tmp_path}'",
                     f"logger.tensorboard.save_dir='{tmp_path}'")  # fmt: skip
    with pytest.raises(Exception, match="TensorBoard is not installed") as error:
        train(config, tmp_path)
    assert one_line(error.value).startswith(
        "logger=tensorboard: TensorBoard is not installed; say pip install"
    )


@pytest.mark.parametrize("asked", [["trainer.max_steps=3", "seed=1"], ["seed=1"]])
def test_options_without_a_gradient_are_said_to_be_unused(asked, file, tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.DEBUG)
    hydra = SimpleNamespace(overrides=SimpleNamespace(task=asked))
    monkeypatch.setattr(command, "HydraConfig", SimpleNamespace(initialized=lambda: True, get=lambda: hydra))
    settings = [s for s in brief(file) if not s.startswith("model.")]
    train(compose(*settings, "model=nearest"), tmp_path)
    (record,) = [r for r in caplog.records if "does not train by gradient" in r.message]
    loud = len(asked) > 1
    assert record.levelno == (logging.WARNING if loud else logging.DEBUG)
    assert ("(trainer.max_steps=3)" in record.message) == loud


# -- weights to start from ----------------------------------------------------------------------------


def test_training_starts_from_given_weights_on_rows_of_another_campaign(trained, tmp_path):
    """Another campaign's box, and with it the origin of local coordinates, is never quite the same."""
    new = spectra(tmp_path / "new.npz", rows=55)
    more = ("model.refit=false", f"init_from='{trained}'")
    config = compose(*brief(new, "trainer.max_steps=1", *more, *STILL))
    _, objects = train(config, tmp_path / "still")
    before, after = weights(trained), weights(objects.checkpoints[0])
    moved = [k for k in before if k.startswith("gaussians.") and not torch.equal(before[k], after[k])]
    assert not moved and len(objects.data) == 55
    _, objects = train(compose(*brief(new, *more)), tmp_path / "on")
    assert not torch.equal(weights(objects.checkpoints[0])["gaussians.means"], before["gaussians.means"])


def test_weights_of_another_site_are_refused_in_one_line(trained, tmp_path):
    others = {"rx": spectra(tmp_path / "rx.npz", moving="rx"), "csi": channels(tmp_path / "csi.npz"),
              "far": spectra(tmp_path / "far.npz", origin=100.0)}  # fmt: skip
    says = {
        "rx": "trained with static_end rx",
        "csi": "trained with kind spectrum",
        "far": "from the model's",
    }
    for name, other in others.items():
        with pytest.raises(ValueError, match=f"init_from=.*{says[name]}") as error:
            train(compose(*brief(other, f"init_from='{trained}'")), tmp_path / name)
        assert "\n" not in str(error.value)


def test_weights_mean_nothing_to_a_method_without_any(file, trained, tmp_path):
    settings = [s for s in brief(file) if not s.startswith("model.")]
    with pytest.raises(ValueError, match="init_from: nearest does not train by gradient"):
        train(compose(*settings, "model=nearest", f"init_from='{trained}'"), tmp_path)
    with pytest.raises(ValueError, match=r"init_from=none\.ckpt: .*no such checkpoint"):
        train(compose(*brief(file, "init_from=none.ckpt")), tmp_path)


# -- Lightning's own way to a model -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["model.ckpt", "last.ckpt"])
def test_the_module_of_a_checkpoint_predicts_what_gsparc_load_does(name, file, trained):
    path = trained.parent / name
    module = module_of(path)
    data = datamodule({"name": "own", "file": str(file)}).measurements
    rows = np.arange(20)
    shown = Loaded(data, 8).use(Fold(rows, rows[:0], rows))
    trainer = Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_checkpointing=False)
    predicted = torch.cat(trainer.predict(module, shown))
    asked = gsparc.load(path).spectrum(tx=data.tx[rows] + data.site.origin)
    assert predicted.shape == (20, 16, 32) and np.abs(predicted.numpy() - asked).max() < 1e-5


def test_a_method_without_a_field_has_no_module(file, tmp_path):
    settings = [s for s in brief(file) if not s.startswith("model.")]
    _, objects = train(compose(*settings, "model=nearest"), tmp_path)
    with pytest.raises(checkpoint.CheckpointError, match="nearest holds no Gaussian field"):
        module_of(objects.checkpoints[0])


# -- the objective of a search ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["spectrum", "csi", "rssi"])
def test_the_objective_is_a_figure_of_the_kind(kind):
    config = compose("eval_on=val")
    assert objective_of(config, kind) == DECIDING[kind] and DECIDING[kind] in figure_names(kind)
    for figure in (*figure_names(kind), "skill"):
        config.objective = f"val/{figure}"
        assert objective_of(config, kind) == figure
    config.objective = "val/nmsee"
    with pytest.raises(ValueError, match=r"objective=val/nmsee: no such figure; did you mean 'val/nmse'\?"):
        objective_of(config, kind)


def test_every_figure_grows_when_the_prediction_is_better():
    """Each of them by name: what is not listed as smaller-is-better is maximised."""
    better_is_larger = {"ssim", "ssim_median", "ssim_gauss", "psnr_db", "snr_db"}
    better_is_larger |= {f"snr_db_p{p}" for p in (10, 50, 90)}
    for kind in DECIDING:
        for figure in figure_names(kind):
            assert lower_is_better(figure) == (figure not in better_is_larger), figure
            assert (score_of(figure, 0.2) > score_of(figure, 0.1)) == (figure in better_is_larger)


def test_an_unknown_objective_stops_the_run_before_it_trains(file, tmp_path):
    with pytest.raises(ValueError, match="did you mean 'test/psnr_db'"):
        train(compose(*brief(file, "objective=test/psnr")), tmp_path)
    assert not (tmp_path / "model.ckpt").exists()
