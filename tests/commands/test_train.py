"""`train()` and its command, end to end on files of a second."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import brief, channels, compose, powers, spectra
from doors import knock
from omegaconf import open_dict

import gsparc
from gsparc.commands import evaluate
from gsparc.commands.train import Objects, main, train
from gsparc.data.load import load as load_data
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.parts import Origin
from gsparc.models.splat.method import LearnedField
from gsparc.training.context import FitContext

ROOT = Path(__file__).parents[2]
CONTRACT = {  # what scripts read of a summary
    "time/train_s", "time/render_ms_p50", "time/render_ms_p95", "time/includes", "machine/threads",
    "machine/load", "model/num_gaussians", "model/effects", "memory/peak_mb", "dataset/name",
    "dataset/sha256", "dataset/stand_in", "dataset/convergence_error", "split/name", "split/sha256", "seed",
    "git", "versions",
}  # fmt: skip
FIGURES = {
    "spectrum": {"ssim", "ssim_median", "ssim_gauss", "psnr_db", "nmse", "skill"},
    "csi": {"nmse", "snr_db", "skill", "nmse_scalar"},
    "rssi": {"rmse_db", "nmse", "skill"},
}
PAIRED = {"spectrum": "psnr_db", "csi": "snr_db", "rssi": None}
KINDS = {"spectrum": spectra, "csi": channels, "rssi": powers}


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_leaves_every_key_of_the_contract(kind, tmp_path):
    file = KINDS[kind](tmp_path / "own.npz")
    facts, objects = train(compose(*brief(file, "baselines=[nearest,mean,gp]")), tmp_path / "run")
    stored = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert set(stored) >= CONTRACT and {f"test/{name}" for name in FIGURES[kind]} <= set(stored)
    assert {"baseline/nearest/skill", "baseline/gp/train_s", "baseline/mean/render_ms_p50"} <= set(stored)
    if PAIRED[kind]:
        assert {f"paired/gp/{PAIRED[kind]}", f"paired/gp/{PAIRED[kind]}_se"} <= set(stored)
    assert all(value is None or isinstance(value, (int, float, str)) for value in stored.values())
    assert stored["model/num_gaussians"] == 40 and stored["time/train_s"] > 0 and stored["seed"] == 0
    assert stored["machine/threads"] == 1 and stored["dataset/name"] == facts["dataset/name"] == "own"
    assert isinstance(objects, Objects) and isinstance(objects.methods[0], LearnedField)
    assert objects.checkpoints[0].exists() and (tmp_path / "run" / "per_sample.csv").exists()
    assert (tmp_path / "run" / "split.json").exists() and (tmp_path / "run" / "learning_curve.csv").exists()


@pytest.mark.parametrize("model", ["zero", "mean", "nearest", "idw", "gp"])
def test_methods_without_a_gradient_take_the_same_road(model, tmp_path):
    file = spectra(tmp_path / "own.npz")
    settings = [s for s in brief(file) if not s.startswith("model.")]
    facts, objects = train(compose(*settings, f"model={model}"), tmp_path / "run")
    assert facts["model/name"] == model and facts["time/train_s"] >= 0
    assert np.isfinite(facts["test/psnr_db"]) and objects.checkpoints[0].exists()


def test_a_budget_that_a_method_does_not_take_is_said(tmp_path, caplog):
    """`effects.array=true budget_s=5` took its time without a word."""
    settings = [s for s in brief(spectra(tmp_path / "own.npz")) if not s.startswith("model.")]
    facts, _ = train(compose(*settings, "model=mean", "budget_s=5"), tmp_path / "run")
    assert "budget_s=5 is not used: the seconds of mean cannot be chosen" in caplog.text
    assert facts["model/limited_by_clock"] is None


def test_a_checkpoint_evaluates_to_the_same_figures(tmp_path):
    file = spectra(tmp_path / "own.npz")
    facts, objects = train(compose(*brief(file)), tmp_path / "run")
    found, _, _ = evaluate.evaluate_files(objects.checkpoints, baselines=["mean"])
    same = [key for key in facts if key.startswith("test/")]
    assert len(same) > 5 and all(found.facts[key] == facts[key] for key in same)
    image = gsparc.load(objects.checkpoints[0]).spectrum(tx=[0.1, 0.2, 0.1])
    assert image.shape == (16, 32) and image.max() <= 1


def test_folds_have_folders_and_are_pooled(tmp_path):
    file = spectra(tmp_path / "own.npz")
    settings = brief(file, "split=grouped", "split.folds=2", "model.refit=false", "split.buffer_m=0")
    facts, objects = train(compose(*settings), tmp_path / "run")
    assert [p.parent.name for p in objects.checkpoints] == ["fold0", "fold1"]
    assert facts["split/folds"] == 2 and facts["test/samples"] == 40
    assert facts["time/train_total_s"] == pytest.approx(2 * facts["time/train_s"])


def test_the_simulated_stand_in_says_so(tmp_path):
    settings = [s for s in brief(tmp_path) if not s.startswith("dataset")]
    config = compose(*settings, "dataset=rfid_sim", "dataset.count=30", f"dataset.root={tmp_path}")
    facts, _ = train(config, tmp_path / "run")
    assert facts["dataset/name"] == "rfid-sim" and facts["dataset/stand_in"]


def test_loss_decreases_and_the_field_beats_the_mean_on_simulated_channels(tmp_path):
    file = channels(tmp_path / "own.npz", rows=150)
    config = compose(
        *brief(file, "trainer.max_steps=150", "trainer.val_check_interval=25", "model.field.count=80")
    )
    facts, _ = train(config, tmp_path / "run")
    rows = (tmp_path / "run" / "learning_curve.csv").read_text().splitlines()
    column = rows[0].split(",").index("train/task_loss")
    losses = [float(row.split(",")[column]) for row in rows[1:]]
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

    def log_metrics(self, metrics, step=None):
        self.metrics = metrics

    def finalize(self, status):
        self.closed.append(status)


@pytest.mark.parametrize("fails", [False, True])
def test_loggers_are_closed_whatever_happens(tmp_path, monkeypatch, fails):
    file = spectra(tmp_path / "own.npz")
    settings = [s for s in brief(file) if not s.startswith("model.")]
    config = compose(*settings, "model=mean")
    with open_dict(config):
        config.logger = {"own": {"_target_": f"{__name__}.Recording"}}
    Recording.made.clear()
    if fails:
        monkeypatch.setattr("gsparc.commands.train.evaluate", lambda *a, **k: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            train(config, tmp_path / "run")
    else:
        train(config, tmp_path / "run")
        said = Recording.made[0].metrics
        assert said["final/test/psnr_db"] and not [k for k in said if not k.startswith("final/")]
    assert Recording.made[0].closed == ["failed" if fails else "success"]


def test_a_finished_model_is_no_training_state(tmp_path):
    file = spectra(tmp_path / "own.npz")
    _, objects = train(compose(*brief(file, "model.refit=false")), tmp_path / "run")
    with pytest.raises(ValueError, match=r"resume from last\.ckpt instead"):
        train(compose(*brief(file, f"ckpt_path={objects.checkpoints[0]}")), tmp_path / "again")


def test_another_methods_model_is_no_training_state(tmp_path):
    """It was taken for an interrupted run: `gsparc has not been trained: call fit() or load a checkpoint`."""
    file = spectra(tmp_path / "own.npz")
    settings = [s for s in brief(file) if not s.startswith("model.")]
    _, objects = train(compose(*settings, "model=nearest"), tmp_path / "run")
    with pytest.raises(ValueError, match=r"resume from last\.ckpt instead"):
        train(compose(*brief(file, f"ckpt_path={objects.checkpoints[0]}")), tmp_path / "again")


def test_a_missing_checkpoint_is_named(tmp_path):
    file = spectra(tmp_path / "own.npz")
    with pytest.raises(ValueError, match=r"gone\.ckpt: no such file"):
        train(compose(*brief(file, "ckpt_path=gone.ckpt")), tmp_path / "run")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A file of spectra, and what an interrupted run of `split=random` on it left."""
    folder = tmp_path_factory.mktemp("interrupted")
    file = spectra(folder / "own.npz")
    often = "callbacks.checkpoint.every_n_train_steps=10"
    train(compose(*brief(file, "model.refit=false", often)), folder / "run")
    return file, folder / "run" / "last.ckpt"


@pytest.mark.parametrize(
    "change,said",
    [
        ("split=corner", r"split\.name=random \(here corner\)"),
        ("split.seed=3", r"split\.seed=0 \(here 3\)"),
        ("seed=3", r"seed=0 \(here 3\)"),
        ("model.field.count=41", r"model\.field\.count=\d+ \(here 41\)"),
        ("model.emission.hidden=7", r"model\.emission\.hidden=\d+ \(here 7\)"),
        ("dataset.batch_size=5", r"dataset\.batch_size=\d+ \(here 5\)"),
        ("stations=together", r"stations=auto \(here together\)"),  # a model of each was shown as one of all
    ],
)
def test_a_run_goes_on_with_the_same_split_seed_and_settings_or_not_at_all(
    interrupted, tmp_path, change, said
):
    """Rows learned before were tested on: 29 or 41 dB were shown where 20 are true."""
    file, last = interrupted
    with pytest.raises(ValueError, match=rf"last\.ckpt: was trained with {said}"):
        train(compose(*brief(file, "model.refit=false", change, f"ckpt_path={last}")), tmp_path)
    assert not (tmp_path / "summary.json").exists()


def test_a_run_goes_on_with_the_same_data_or_not_at_all(interrupted, tmp_path):
    _, last = interrupted
    other = spectra(tmp_path / "other.npz", origin=1.0)
    with pytest.raises(ValueError, match=r"was trained with dataset\.file=.*own\.npz \(here .*other\.npz\)"):
        train(compose(*brief(other, "model.refit=false", f"ckpt_path={last}")), tmp_path / "run")


def altered(last: Path, to: Path, change: Callable[[dict], object]) -> Path:
    """The checkpoint with its content changed."""
    content = torch.load(last, weights_only=True)
    change(content)
    torch.save(content, to)
    return to


def test_a_run_goes_on_with_the_same_grid_or_not_at_all(interrupted, tmp_path):
    """The content hash does not know it."""
    file, last = interrupted
    with np.load(file) as stored:
        np.savez(tmp_path / "own.npz", **stored, grid_deg=[0.0, 0.0, 3.0, 10.0])
    settings = brief(tmp_path / "own.npz", "model.refit=false", f"ckpt_path={last}")
    with pytest.raises(ValueError, match=r"last\.ckpt: was trained with other grid: go on with the same"):
        train(compose(*settings), tmp_path / "run")


@pytest.mark.parametrize(
    "what, change",
    [
        ("other directions or uplink", lambda d: replace(d, directions=[np.ones((2, 3))] * len(d))),
        ("other directions or uplink", lambda d: replace(d, uplink=np.ones((len(d), 1, 1), np.complex64))),
        ("other normalisation", lambda d: replace(d, site=replace(d.site, normalisation="power"))),
        ("other origin", lambda d: replace(d, site=replace(d.site, origin=d.site.origin + 1))),
        ("other antennas", lambda d: replace(d, site=replace(d.site, antennas=np.arange(2)))),
    ],
)
def test_facts_beside_the_content_hash_are_of_an_origin(interrupted, what, change):
    file, last = interrupted
    data = load_data({"name": "own", "file": str(file)})
    fold = Fold(np.arange(9), np.arange(9, 12), np.arange(12, 20))
    before, now = (Origin.of(d, fold, FitContext()) for d in (data, change(data)))
    stored = replace(checkpoint.read(last), config="", extra=before.marks())
    before.refuse_other(stored)
    with pytest.raises(ValueError, match=f"was trained with {what}: go on"):
        now.refuse_other(stored)


def test_weights_to_start_from_beside_a_run_to_go_on_from_are_refused(interrupted, tmp_path):
    """`init_from=` was ignored; a run that began with it goes on with it, in its coordinates."""
    file, last = interrupted
    first = train(compose(*brief(file, "model.refit=false")), tmp_path / "first")[1].checkpoints[0]
    start = f"init_from={first}"
    with pytest.raises(ValueError, match=r"was trained with init_from=None \(here .*model\.ckpt\)"):
        train(compose(*brief(file, "model.refit=false", start, f"ckpt_path={last}")), tmp_path / "run")
    often = "callbacks.checkpoint.every_n_train_steps=10"
    train(compose(*brief(file, "model.refit=false", start, often)), tmp_path / "second")
    on = f"ckpt_path={tmp_path / 'second' / 'last.ckpt'}"
    assert train(compose(*brief(file, "model.refit=false", start, on)), tmp_path / "third")
    with pytest.raises(ValueError, match=r"was trained with init_from=.*model\.ckpt \(here None\)"):
        train(compose(*brief(file, "model.refit=false", on)), tmp_path / "fourth")


SPOILT = {
    "optimizer_states": lambda t: t["optimizer_states"][0]["param_groups"][1].update(lr=np.nan),
    "lr_schedulers": lambda t: t["lr_schedulers"][0]["base_lrs"].__setitem__(2, np.nan),
    "callbacks.CostLedger": lambda t: t["callbacks"]["CostLedger"].update(seconds=np.nan),
}


@pytest.mark.parametrize("where", SPOILT)
def test_a_training_state_that_is_not_finite_is_refused_before_training(interrupted, tmp_path, where):
    """One rate of NaN trained on unnoticed; seconds of NaN failed when training was over."""
    file, last = interrupted
    spoilt = altered(
        last, tmp_path / "spoilt.ckpt", lambda content: SPOILT[where](content["extra"]["trainer"])
    )
    with pytest.raises(ValueError, match=rf"trainer\.{re.escape(where)}.* is NaN or infinite; resume from"):
        train(compose(*brief(file, "model.refit=false", f"ckpt_path={spoilt}")), tmp_path / "run")
    assert not (tmp_path / "run" / "learning_curve.csv").exists()


def test_settings_of_the_schedule_may_change_and_are_named(interrupted, tmp_path, caplog):
    file, last = interrupted
    train(compose(*brief(file, "model.refit=false", "trainer.max_steps=25", f"ckpt_path={last}")), tmp_path)
    assert re.search(r"which had trainer\.max_steps=\d+ \(here 25\)", caplog.text)


def start(file: Path, folder: Path, *more: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "train.py", *brief(file, *more), f"hydra.run.dir={folder}"],
        cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_an_interrupt_leaves_a_checkpoint_that_goes_on(tmp_path):
    file = spectra(tmp_path / "own.npz")
    more = (
        "trainer.max_steps=100000",
        "callbacks.checkpoint.every_n_train_steps=10",
        "model.refit=false",
        "trainer.val_check_interval=50000",
    )
    run = start(file, tmp_path / "run", *more)
    last = tmp_path / "run" / "last.ckpt"
    until = time.monotonic() + 120
    while not last.exists() and time.monotonic() < until:
        time.sleep(0.01)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=60)
    assert run.returncode == 130 and f"go on with ckpt_path={last}" in said and "Traceback" not in said
    reached = checkpoint.read(last).extra["trainer"]["global_step"]
    more = (
        f"trainer.max_steps={reached + 5}",
        f"ckpt_path={last}",
        "model.refit=false",
        "trainer.val_check_interval=50000",
    )
    facts, _ = train(compose(*brief(file, *more)), tmp_path / "on")
    assert np.isfinite(facts["test/psnr_db"])
    assert checkpoint.read(tmp_path / "on" / "model.ckpt").method == "gsparc"


@pytest.mark.slow
def test_wandb_offline_is_closed_and_holds_curves_a_picture_and_the_table(tmp_path):
    file = spectra(tmp_path / "own.npz")
    run = start(file, tmp_path / "run", "logger=wandb")
    _, said = run.communicate(timeout=240)
    assert run.returncode == 0, said
    (folder,) = (tmp_path / "run" / "wandb").glob("offline-run-*")
    (stored,) = folder.glob("*.wandb")
    names = (b"train/loss", b"val/psnr_db", b"model/num_gaussians", b"rate/", b"final/test/psnr_db")
    assert all(name in stored.read_bytes() for name in names)
    media = folder / "files" / "media"
    assert list(media.glob("images/test rows*.png")) and list(media.glob("images/predictions*.png"))
    (table,) = (json.loads(file.read_text()) for file in media.glob("table/results*.json"))
    assert table["columns"][0] == "method" and "gsparc" in [row[0] for row in table["data"]]


@pytest.mark.parametrize("way", [(), ("-m", "seed=0,1")], ids=["a run", "a sweep"])
def test_the_objective_is_for_searches_alone(tmp_path, way):
    """One power heard of sixty: everything was written, then `error: objective=test/rmse_db`, exit 1."""
    where = np.random.default_rng(0).uniform(0, 20, (60, 3))
    heard = np.full(60, np.nan)
    heard[7] = -60.0
    np.savez(
        tmp_path / "own.npz", rx_position=where, tx_position=np.zeros(3), rssi_db=heard, sensitivity_db=-90.0
    )
    folder = [f"hydra.run.dir={tmp_path / 'run'}", f"hydra.sweep.dir={tmp_path / 'run'}"]
    given = [
        "dataset=own",
        f"dataset.file={tmp_path / 'own.npz'}",
        "model=mean",
        "baselines=[]",
        "logger=none",
    ]
    answer = knock(main, "train.py", [*way, *given, *folder, "threads=1", "split.seed=0"])
    assert answer.status == 0 and not [line for line in answer.err if line.startswith("error")], answer
    written = list((tmp_path / "run").rglob("summary.json"))
    assert len(written) == (2 if way else 1)
    assert all(json.loads(file.read_text())["test/rmse_db"] is None for file in written)
