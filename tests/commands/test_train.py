"""`train()` and its command, end to end on files of a second."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, powers, spectra
from doors import assert_refused, knock
from lightning.pytorch import Trainer
from omegaconf import open_dict

import gsparc
from gsparc.commands import evaluate
from gsparc.commands.train import Objects, main, train
from gsparc.data.datamodule import Loaded
from gsparc.data.load import datamodule
from gsparc.data.load import load as load_data
from gsparc.data.splits import Fold
from gsparc.evaluation.console import one_line
from gsparc.evaluation.experiment import options
from gsparc.models import checkpoint
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.models.fitting import Origin
from gsparc.models.loading import module_of
from gsparc.models.splat.method import LearnedField
from gsparc.training import curve
from gsparc.training.context import FitContext

ROOT = Path(__file__).parents[2]


KINDS = {"spectrum": spectra, "csi": channels, "rssi": powers}
STILL = [f"model.optimizer.{name}=0" for name in ("positions", "positions_final", "scales", "rotations",
         "opacities", "emission", "confidence", "gain")]  # fmt: skip


def short(file: Path, *more: str):
    """The configuration of a training of a second whose model may go on."""
    return compose(*brief(file, "model.refit=false", *more))


def plain(file: Path, model: str, *more: str):
    """The configuration of a method without a gradient."""
    return compose(*(s for s in brief(file) if not s.startswith("model.")), f"model={model}", *more)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return checkpoint.read(path).state["inner"]["model"]


def steps(folder: Path) -> list[int]:
    """Those that a learning curve has rows of, after the start."""
    return [int(row["step"]) for row in curve.read(folder) if row["what"].startswith("step ")]


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_leaves_facts_and_files(kind, tmp_path):
    """What `evaluate` finds, and beside it what a training alone knows."""
    file = KINDS[kind](tmp_path / "own.npz")
    facts, objects = train(compose(*brief(file, "baselines=[nearest,mean,gp]")), tmp_path / "run")
    stored = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert {"seed", "git", "versions", "memory/peak_mb", "test/skill"} <= set(stored)
    assert all(value is None or isinstance(value, (int, float, str)) for value in stored.values())
    assert stored["model/num_gaussians"] == 40 and stored["time/train_s"] > 0 and stored["seed"] == 0
    assert stored["machine/threads"] == 1 and stored["dataset/name"] == facts["dataset/name"] == "own"
    assert isinstance(objects, Objects) and isinstance(objects.methods[0], LearnedField)
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"model.ckpt", "per_sample.csv", "split.json", "learning_curve.csv"} <= written


@pytest.mark.parametrize("model", ["zero", "idw", "gp"])
def test_a_method_without_a_gradient_is_trained(model, spectra_file, tmp_path):
    facts, objects = train(plain(spectra_file, model, "baselines=[]", "budget_s=5"), tmp_path)
    assert facts["model/name"] == model and facts["time/train_s"] >= 0
    assert np.isfinite(facts["test/psnr_db"]) and objects.checkpoints[0].exists()
    assert facts["model/limited_by_clock"] is None


@pytest.mark.parametrize("more, times", [([], 1), (["model.components=3"], 2)])
def test_a_method_with_the_settings_of_a_baseline_is_fitted_once(
    more, times, spectra_file, tmp_path, monkeypatch
):
    fits, fit = [], GaussianProcess.fit
    monkeypatch.setattr(GaussianProcess, "fit", lambda *given: fits.append(1) or fit(*given))
    facts, _ = train(plain(spectra_file, "gp", "baselines=[gp]", *more), tmp_path)
    assert len(fits) == times
    assert (facts["test/psnr_db"] == facts["baseline/gp/psnr_db"]) == (times == 1)


def test_a_checkpoint_evaluates_to_the_same_figures(field):
    facts, checkpoints = field.evaluation.facts, field.checkpoints
    found, _, _ = evaluate.evaluate_files(checkpoints, baselines=["mean"])
    same = [key for key in facts if key.startswith("test/")]
    assert len(same) > 5 and all(found.facts[key] == facts[key] for key in same)
    image = gsparc.load(checkpoints[0]).spectrum(tx=[0.1, 0.2, 0.1])
    assert image.shape == (16, 32) and image.max() <= 1


def test_calls_down_to_the_trainer_are_those_of_the_map(spectra_file, tmp_path, monkeypatch):
    called = []

    def reached(*unused, **named):
        stack = [one.name for one in traceback.extract_stack() if str(ROOT / "gsparc") in one.filename]
        called.extend(name for name in stack if name != "<genexpr>")
        raise ZeroDivisionError

    monkeypatch.setattr(Trainer, "fit", reached)
    with pytest.raises(ZeroDivisionError):
        train(short(spectra_file), tmp_path)
    text = (ROOT / "ARCHITECTURE.md").read_text().partition("Calls down to the Trainer: ")[2]
    named = [name.rpartition(".")[2] for name in re.findall(r"`([\w.]+)`", text.partition(".\n")[0])]
    assert ["task", *called] == named


def test_folds_have_folders_and_are_pooled(spectra_file, tmp_path):
    config = short(spectra_file, "split=grouped", "split.folds=2", "split.buffer_m=0")
    facts, objects = train(config, tmp_path)
    assert [p.parent.name for p in objects.checkpoints] == ["fold0", "fold1"]
    assert facts["split/folds"] == 2 and facts["test/samples"] == 40
    assert facts["time/train_total_s"] == pytest.approx(2 * facts["time/train_s"])


def test_a_file_of_a_run_without_folds_was_no_error(field, spectra_file, tmp_path):
    """All folds began anew: `not folder.glob(...)` is never true, as a generator is not empty."""
    config = short(spectra_file, "split=grouped", "split.folds=2", "split.buffer_m=0")
    config.ckpt_path = str(field.checkpoints[0])
    with pytest.raises(ValueError, match="split=grouped has 2 folds, give the run's folder"):
        train(config, tmp_path)


def test_files_in_a_list_were_an_error_of_their_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for name in ("a.csv", "b.csv"):
        rows = [f"{x:.2f},{y:.2f},1.5,{-60 - x:.2f}" for x, y in rng.uniform(0, 30, (40, 2))]
        (tmp_path / name).write_text("\n".join(["rx_x,rx_y,rx_z,RSSI (dBm)", *rows]))
    settings = ("dataset=own", "dataset.file=[a.csv,b.csv]", "model=mean", "baselines=[]", "logger=none")
    summary, _ = train(compose(*settings), tmp_path / "run")
    assert summary["split/train"] + summary["split/val"] + summary["split/test"] == 80
    stored = checkpoint.read(tmp_path / "run" / "model.ckpt").configuration["dataset"]["file"]
    assert stored == [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]


def test_the_simulated_stand_in_says_so(tmp_path):
    settings = [s for s in brief(tmp_path) if not s.startswith(("dataset", "model."))]
    chosen = "dataset=rfid_sim", "dataset.count=30", f"dataset.root={tmp_path}", "model=mean"
    facts, _ = train(compose(*settings, *chosen), tmp_path / "run")
    assert facts["dataset/name"] == "rfid-sim" and facts["dataset/stand_in"]


def test_loss_decreases_and_the_field_beats_the_mean_on_simulated_channels(tmp_path):
    file = channels(tmp_path / "own.npz", rows=150)
    more = "trainer.max_steps=150", "trainer.val_check_interval=25", "model.field.count=80"
    facts, _ = train(short(file, *more), tmp_path / "run")
    rows = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()
    column = rows[0].split(",").index("train/task_loss")
    losses = [float(row.split(",")[column]) for row in rows[2:-1]]  # between the start and `final`
    assert losses[-1] < 0.5 * losses[0]
    assert facts["test/nmse"] < 0.8 * facts["baseline/mean/nmse"]


class Recording:
    """A logger that remembers how it was closed."""

    made: list = []  # noqa: RUF012

    def __init__(self) -> None:
        from lightning.pytorch.loggers import CSVLogger

        self.inner = CSVLogger(os.devnull)
        self.closed: list[str] = []
        Recording.made.append(self)

    def log_hyperparams(self, settings):
        self.settings = settings

    def log_metrics(self, metrics, step=None):
        self.metrics = metrics

    def finalize(self, status):
        self.closed.append(status)


@pytest.mark.parametrize("fails", [False, True])
def test_loggers_are_closed_whatever_happens(spectra_file, tmp_path, monkeypatch, fails):
    config = plain(spectra_file, "mean")
    with open_dict(config):
        config.logger = {"own": {"_target_": f"{__name__}.Recording"}}
    Recording.made.clear()
    if fails:
        monkeypatch.setattr("gsparc.commands.train.evaluate", lambda *a, **k: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            train(config, tmp_path)
    else:
        train(config, tmp_path)
        metrics = Recording.made[0].metrics
        assert metrics["final/test/psnr_db"] and not [k for k in metrics if not k.startswith("final/")]
    assert Recording.made[0].closed == ["failed" if fails else "success"]


# -- what a run goes on from, and starts from -----------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("split=corner", r"split\.name=random \(here corner\)"),
        ("split.seed=3", r"split\.seed=0 \(here 3\)"),
        ("seed=3", r"seed=0 \(here 3\)"),
        ("model.field.count=41", r"model\.field\.count=\d+ \(here 41\)"),
        ("model.emission.hidden=7", r"model\.emission\.hidden=\d+ \(here 7\)"),
        ("dataset.batch_size=5", r"dataset\.batch_size=\d+ \(here 5\)"),
        ("stations=together", r"stations=auto \(here together\)"),  # a model of each was shown as one of all
        ("dataset.file={other}", r"dataset\.file=.*own\.npz \(here .*other\.npz\)"),
        # It was ignored; a run that began with it goes on with it, in its coordinates.
        ("init_from={model}", r"init_from=None \(here .*model\.ckpt\)"),
    ],
)
def test_a_run_goes_on_with_the_same_split_seed_and_settings_or_not_at_all(
    spectra_file, halfway, tmp_path, change, message
):
    """Rows learned before were tested on: 29 or 41 dB were shown where 20 are true."""
    model = halfway.checkpoints[0]
    last, other = model.with_name("last.ckpt"), spectra(tmp_path / "other.npz", origin=1.0)
    change = change.format(other=other, model=model)
    with pytest.raises(ValueError, match=rf"last\.ckpt: was trained with {message}"):
        train(short(spectra_file, change, f"ckpt_path={last}"), tmp_path)
    assert not (tmp_path / "summary.json").exists()


def test_a_run_goes_on_with_the_same_grid_or_not_at_all(spectra_file, halfway, tmp_path):
    """The content hash does not know it."""
    with np.load(spectra_file) as stored:
        np.savez(tmp_path / "own.npz", **stored, grid_deg=[0.0, 0.0, 3.0, 10.0])
    last = halfway.checkpoints[0].with_name("last.ckpt")
    with pytest.raises(ValueError, match=r"last\.ckpt: was trained with other grid: go on with the same"):
        train(short(tmp_path / "own.npz", f"ckpt_path={last}"), tmp_path / "run")


@pytest.mark.parametrize(("what", "change"), [
    ("other directions or uplink", lambda d: replace(d, directions=[np.ones((2, 3))] * len(d))),
    ("other directions or uplink", lambda d: replace(d, uplink=np.ones((len(d), 1, 1), np.complex64))),
    ("other normalisation", lambda d: replace(d, site=replace(d.site, normalisation="power"))),
    ("other origin", lambda d: replace(d, site=replace(d.site, origin=d.site.origin + 1))),
    ("other antennas", lambda d: replace(d, site=replace(d.site, antennas=np.arange(2)))),
])  # fmt: skip
def test_facts_beside_the_content_hash_are_of_an_origin(spectra_file, halfway, what, change):
    data = load_data({"name": "own", "file": str(spectra_file)})
    fold = Fold(np.arange(9), np.arange(9, 12), np.arange(12, 20))
    before, now = (Origin.of(d, fold, FitContext()) for d in (data, change(data)))
    stored = checkpoint.read(halfway.checkpoints[0].with_name("last.ckpt"))
    stored = replace(stored, config="", extra=before.marks())
    before.refuse_other(stored)
    with pytest.raises(ValueError, match=f"was trained with {what}: go on"):
        now.refuse_other(stored)


def test_weights_to_start_from_beside_a_run_to_go_on_from_are_those_it_began_with(
    spectra_file, halfway, tmp_path
):
    often, start = "callbacks.checkpoint.interval=10", f"init_from={halfway.checkpoints[0]}"
    train(short(spectra_file, start, often), tmp_path / "begun")
    on = f"ckpt_path={tmp_path / 'begun' / 'last.ckpt'}"
    assert train(short(spectra_file, start, on), tmp_path / "on")
    with pytest.raises(ValueError, match=r"was trained with init_from=.*model\.ckpt \(here None\)"):
        train(short(spectra_file, on), tmp_path / "without")


SPOILT = {
    "optimizer_states": lambda t: t["optimizer_states"][0]["param_groups"][1].update(lr=np.nan),
    "lr_schedulers": lambda t: t["lr_schedulers"][0]["base_lrs"].__setitem__(2, np.nan),
    "callbacks.CostLedger": lambda t: t["callbacks"]["CostLedger"].update(seconds=np.nan),
}


@pytest.mark.parametrize("where", SPOILT)
def test_a_training_state_that_is_not_finite_is_refused_before_training(
    spectra_file, halfway, tmp_path, where
):
    """One rate of NaN trained on unnoticed; seconds of NaN failed when training was over."""
    content = torch.load(halfway.checkpoints[0].with_name("last.ckpt"), weights_only=True)
    SPOILT[where](content["extra"]["trainer"])
    torch.save(content, tmp_path / "spoilt.ckpt")
    with pytest.raises(ValueError, match=rf"trainer\.{re.escape(where)}.* is NaN or infinite; resume from"):
        train(short(spectra_file, f"ckpt_path={tmp_path / 'spoilt.ckpt'}"), tmp_path / "run")
    assert not (tmp_path / "run" / "learning_curve.csv").exists()


def test_settings_of_the_schedule_may_change_and_are_named(spectra_file, halfway, tmp_path, caplog):
    last = halfway.checkpoints[0].with_name("last.ckpt")
    train(short(spectra_file, "trainer.max_steps=25", f"ckpt_path={last}"), tmp_path)
    assert re.search(r"which had trainer\.max_steps=\d+ \(here 25\)", caplog.text)


def test_checkpoints_come_when_asked_for_and_go_on_bit_identically(spectra_file, halfway, tmp_path):
    last = halfway.checkpoints[0].with_name("last.ckpt")
    assert checkpoint.read(last).extra["trainer"]["global_step"] == 20  # the last step leaves one, too
    _, objects = train(short(spectra_file, f"ckpt_path='{last}'"), tmp_path)
    whole, resumed = weights(halfway.checkpoints[0]), weights(objects.checkpoints[0])
    assert whole.keys() == resumed.keys() and all(torch.equal(whole[k], resumed[k]) for k in whole)


def test_training_starts_from_given_weights_on_rows_of_another_campaign(halfway, tmp_path):
    """Another campaign's box, and with it the origin of local coordinates, is never quite the same."""
    new = spectra(tmp_path / "new.npz", rows=55)
    before = weights(halfway.checkpoints[0])
    after = {}
    for name, more in {"still": STILL, "on": ()}.items():
        config = short(new, f"init_from='{halfway.checkpoints[0]}'", "trainer.max_steps=1", *more)
        _, objects = train(config, tmp_path / name)
        after[name] = weights(objects.checkpoints[0])
    same = [torch.equal(after["still"][k], before[k]) for k in before if k.startswith("gaussians.")]
    assert all(same) and len(same) > 3 and len(objects.data) == 55
    assert not torch.equal(after["on"]["gaussians.means"], before["gaussians.means"])


@pytest.fixture(scope="module")
def others(halfway, spectra_file, tmp_path_factory) -> dict[str, Path]:
    """Files that are none of `halfway`'s."""
    folder = tmp_path_factory.mktemp("others")
    files = {
        "rx": spectra(folder / "rx.npz", moving="rx"),
        "csi": channels(folder / "csi.npz"),
        "far": spectra(folder / "far.npz", origin=100.0),
    }
    _, nearest = train(plain(spectra_file, "nearest"), folder / "nearest")
    return files | {"model": halfway.checkpoints[0], "nearest": nearest.checkpoints[0]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["ckpt_path={model}"], r"resume from last\.ckpt instead"),
        # It was taken for an interrupted run: `gsparc has not been trained: call fit() or load a checkpoint`.
        (["ckpt_path={nearest}"], r"resume from last\.ckpt instead"),
        (["ckpt_path=gone.ckpt"], r"gone\.ckpt: no such file"),
        (["init_from=none.ckpt"], r"init_from=none\.ckpt: .*no such checkpoint"),
        (["init_from={model}", "dataset.file={rx}"], "init_from=.*trained with static_end rx"),
        (["init_from={model}", "dataset.file={csi}"], "init_from=.*trained with kind spectrum"),
        (["init_from={model}", "dataset.file={far}"], "init_from=.*from the model's"),
        (["init_from={model}", "model=nearest"], "init_from: nearest takes no weights to start from"),
        (["trainer.devices=2"], "say trainer=ddp"),  # several devices need processes that end
    ],
)
def test_what_cannot_be_trained_is_refused_in_one_line(spectra_file, others, tmp_path, changes, message):
    settings = brief(spectra_file, "model.refit=false")
    if "model=nearest" in changes:
        settings = [s for s in settings if not s.startswith("model.")]
    with pytest.raises(ValueError, match=message) as error:
        train(compose(*settings, *(change.format(**others) for change in changes)), tmp_path)
    assert "\n" not in str(error.value) and not (tmp_path / "model.ckpt").exists()


# -- options of the Trainer, and Lightning's own way to a model -------------------------------------------


@pytest.mark.parametrize(("options", "validated"), [
    (["trainer=debug"], [1]),
    (["trainer.precision=bf16-mixed", "+trainer.profiler=simple"], [10, 20]),
    (["trainer.gradient_clip_val=1.0", "trainer.val_check_interval=7"], [7, 14]),
])  # fmt: skip
def test_an_option_of_the_trainer_is_an_override(options, validated, spectra_file, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    facts, _ = train(short(spectra_file, *options), tmp_path)
    assert facts["test/psnr_db"] > 20 and steps(tmp_path) == validated
    assert ("FIT Profiler Report" in caplog.text) == ("+trainer.profiler=simple" in options)


@pytest.mark.slow
def test_two_devices_learn_what_one_does(spectra_file, halfway, tmp_path):
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    facts, objects = train(short(spectra_file, *two), tmp_path)
    assert steps(tmp_path) == [10, 20] and facts["time/train_s"] > 0  # written by one of them
    _, untouched = train(short(spectra_file, "trainer.max_steps=1", *STILL), tmp_path / "start")
    one, both, began = (weights(o.checkpoints[0])["gaussians.means"] for o in (halfway, objects, untouched))
    assert (both - one).norm() < 0.2 * (one - began).norm()  # the same mean gradient, but for rounding


def test_tensorboard_that_is_not_there_is_one_line(spectra_file, tmp_path, monkeypatch):
    def absent(*unused, **named):
        raise ModuleNotFoundError("No module named 'tensorboard'")

    monkeypatch.setattr("lightning.pytorch.loggers.TensorBoardLogger", absent)
    folders = [f"logger.{name}.save_dir='{tmp_path}'" for name in ("csv", "tensorboard")]
    with pytest.raises(Exception, match="TensorBoard is not installed") as error:
        train(compose(*brief(spectra_file), "logger=tensorboard", *folders), tmp_path)
    message = "logger=tensorboard: TensorBoard is not installed; say pip install"
    assert one_line(error.value).startswith(message)


def test_options_without_effect_are_said_and_stored(spectra_file, tmp_path, monkeypatch, caplog):
    """`effects.array=true budget_s=5`, or `trainer.max_steps=3` of a plain method, went without a word."""
    given = {name: f"{name}=3" for name in ("trainer.max_steps", "budget_s", "split.folds", "seed")}
    monkeypatch.setattr(options, "command_line_options", lambda: given)
    train(plain(spectra_file, "nearest", "+split.folds=3"), tmp_path)
    stored = json.loads((tmp_path / "summary.json").read_text())
    assert stored["options/unused"] == "trainer.max_steps=3, budget_s=3, split.folds=3"
    (record,) = [r for r in caplog.records if "without effect" in r.message]
    assert record.levelno == logging.WARNING and "(the seconds of nearest cannot be chosen)" in record.message


@pytest.mark.parametrize("name", ["model.ckpt", "last.ckpt"])
def test_the_module_of_a_checkpoint_predicts_what_gsparc_load_does(name, spectra_file, halfway):
    path = halfway.checkpoints[0].with_name(name)
    module = module_of(path)
    data = datamodule({"name": "own", "file": str(spectra_file)}).measurements
    rows = np.arange(20)
    loaded = Loaded(data, 8).use(Fold(rows, rows[:0], rows))
    trainer = Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_checkpointing=False)
    predicted = torch.cat(trainer.predict(module, loaded))
    expected = gsparc.load(path).spectrum(tx=data.tx[rows] + data.site.origin)
    assert predicted.shape == (20, 16, 32) and np.abs(predicted.numpy() - expected).max() < 1e-5


def test_a_method_without_a_field_has_no_module(others):
    with pytest.raises(checkpoint.CheckpointError, match="nearest holds no Gaussian field"):
        module_of(others["nearest"])


# -- the objective of a search --------------------------------------------------------------------------


@pytest.mark.parametrize("way", [(), ("-m", "seed=0,1")], ids=["a run", "a sweep"])
def test_the_objective_is_for_searches_alone(tmp_path, way):
    """One power heard of sixty: everything was written, then `error: objective=test/rmse_db`, exit 1."""
    where, heard = np.random.default_rng(0).uniform(0, 20, (60, 3)), np.full(60, np.nan)
    heard[7] = -60.0
    powers = {"rssi_db": heard, "sensitivity_db": -90.0}
    np.savez(tmp_path / "own.npz", rx_position=where, tx_position=np.zeros(3), **powers)
    folder = [f"hydra.run.dir={tmp_path / 'run'}", f"hydra.sweep.dir={tmp_path / 'run'}"]
    given = ["dataset=own", f"dataset.file={tmp_path / 'own.npz'}", "model=mean", "baselines=[]"]
    answer = knock(main, "train.py", [*way, *given, *folder, "logger=none", "threads=1", "split.seed=0"])
    assert answer.status == 0 and not [line for line in answer.err if line.startswith("error")], answer
    written = list((tmp_path / "run").glob("*/summary.json" if way else "summary.json"))
    assert len(written) == (2 if way else 1)
    assert all(json.loads(file.read_text())["test/rmse_db"] is None for file in written)
    assert not way or (tmp_path / "run" / "sweep.png").exists()  # of no figure at all: no logarithm


# -- the command itself ---------------------------------------------------------------------------------


def test_an_interrupt_leaves_a_checkpoint_that_goes_on(spectra_file, tmp_path):
    rare = "model.refit=false", "trainer.val_check_interval=50000"
    often = "callbacks.checkpoint.interval=10"
    stopped = "+callbacks.stop={_target_: lost.Interrupt, step: 15}", f"hydra.run.dir={tmp_path / 'run'}"
    answer = knock(main, "train.py", brief(spectra_file, *rare, often, *stopped))
    last = tmp_path / "run" / "last.ckpt"
    assert answer.status == 130 and answer.err[-1].endswith(f"go on with ckpt_path={last}"), answer
    assert not any("Traceback" in line for line in answer.err)
    reached = checkpoint.read(last).extra["trainer"]["global_step"]
    more = f"trainer.max_steps={reached + 5}", f"ckpt_path={last}"
    facts, _ = train(compose(*brief(spectra_file, *rare, *more)), tmp_path / "on")
    assert np.isfinite(facts["test/psnr_db"])
    assert checkpoint.read(tmp_path / "on" / "model.ckpt").method == "gsparc"


def test_the_folder_of_a_run_is_all_it_takes_to_go_on(spectra_file, tmp_path):
    """The settings it did not name were the defaults, and each of them stood in the refusal."""
    stopped = "callbacks.stop={_target_: lost.Interrupt, step: 15}"
    begun = brief(spectra_file, "model.refit=false", f"+{stopped}", f"hydra.run.dir={tmp_path / 'run'}")
    assert knock(main, "train.py", begun).status == 130
    on = f"ckpt_path={tmp_path / 'run'}", f"hydra.run.dir={tmp_path / 'on'}"
    others = [f"model.emission.{name}=0.5" for name in ("init_scale", "init_bias")] + ["seed=3"]
    others += [f"model.effects.{name}=auto" for name in ("array", "phase", "power", "residual")]
    answer = knock(main, "train.py", [*on, *others, "+callbacks.stop=null"])
    assert_refused(answer, r"trained with seed=0 \(here 3\)(, \S+ \(here \S+\)){4} and 2 more: go on with")
    assert knock(main, "train.py", [*on, "+callbacks.stop=null"]).status == 0
    resumed = checkpoint.read(tmp_path / "on" / "model.ckpt").configuration
    assert resumed["dataset"]["file"] == str(spectra_file) and resumed["model"]["field"]["count"] == 40
    assert resumed["seed"] == 0 and resumed["trainer"]["max_steps"] == 20


@pytest.mark.slow
def test_an_interrupted_process_ends_with_130_and_one_line(spectra_file, tmp_path):
    run, often = tmp_path / "run", "callbacks.checkpoint.interval=10"
    words = brief(spectra_file, "trainer.max_steps=100000", often, f"hydra.run.dir={run}")
    process = subprocess.Popen(
        [sys.executable, "train.py", *words], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 120
    while not (run / "last.ckpt").exists() and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and f"go on with ckpt_path={run / 'last.ckpt'}" in err
    assert "Traceback" not in err


@pytest.mark.slow
def test_wandb_offline_is_closed_and_holds_curves_a_picture_and_the_table(spectra_file, tmp_path):
    drawn = "+callbacks.drawn._target_=gsparc.callbacks.Pictures"
    words = brief(spectra_file, "logger=wandb", drawn, f"hydra.run.dir={tmp_path / 'run'}")
    done = subprocess.run([sys.executable, "train.py", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "run" / "wandb").glob("offline-run-*")
    (stored,) = folder.glob("*.wandb")
    names = (b"train/loss", b"val/psnr_db", b"model/num_gaussians", b"rate/", b"final/test/psnr_db")
    assert all(name in stored.read_bytes() for name in names)
    media = folder / "files" / "media"
    assert list(media.glob("images/test rows*.png")) and list(media.glob("images/predictions*.png"))
    (table,) = (json.loads(file.read_text()) for file in media.glob("table/results*.json"))
    assert table["columns"][0] == "method" and "gsparc" in [row[0] for row in table["data"]]
