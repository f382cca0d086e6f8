"""What a training goes on from and starts from: an interrupt, a checkpoint,
the weights of another.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from campaigns import FROZEN, brief, compose, plain, short, spectra, weights
from doors import assert_refused, knock
from lightning.pytorch import Trainer

import gsparc
from gsparc.commands.train import main, train
from gsparc.data.splits import Fold
from gsparc.datasets.datamodule import Loaded
from gsparc.datasets.load import datamodule
from gsparc.datasets.load import load as load_data
from gsparc.models import checkpoint, fitting
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.models.fitting import Origin
from gsparc.models.loading import load_module
from gsparc.training.context import FitContext


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("split=corner", r"split\.name=random \(here corner\)"),
        ("split.seed=3", r"split\.seed=0 \(here 3\)"),
        ("seed=3", r"seed=0 \(here 3\)"),
        ("model.field.count=41", r"model\.field\.count=\d+ \(here 41\)"),
        ("model.emission.hidden=7", r"model\.emission\.hidden=\d+ \(here 7\)"),
        ("dataset.batch_size=5", r"dataset\.batch_size=\d+ \(here 5\)"),
        # A model of each was shown as one of all
        ("stations=together", r"stations=auto \(here together\)"),
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
    with pytest.raises(
        ValueError, match=r"last\.ckpt: was trained with other grid: go on with the same"
    ):
        train(short(tmp_path / "own.npz", f"ckpt_path={last}"), tmp_path / "run")


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("other directions or uplink", lambda d: replace(d, directions=[np.ones((2, 3))] * len(d))),
        (
            "other directions or uplink",
            lambda d: replace(d, uplink=np.ones((len(d), 1, 1), np.complex64)),
        ),
        ("other normalisation", lambda d: replace(d, site=replace(d.site, normalisation="power"))),
        ("other origin", lambda d: replace(d, site=replace(d.site, origin=d.site.origin + 1))),
        ("other antennas", lambda d: replace(d, site=replace(d.site, antennas=np.arange(2)))),
    ],
)
def test_facts_beside_the_content_hash_are_of_an_origin(spectra_file, halfway, what, change):
    data = load_data({"name": "own", "file": str(spectra_file)})
    fold = Fold(np.arange(9), np.arange(9, 12), np.arange(12, 20))
    before, now = (Origin.from_fit(d, fold, FitContext()) for d in (data, change(data)))
    stored = checkpoint.read(halfway.checkpoints[0].with_name("last.ckpt"))
    stored = replace(stored, config="", extra=before.to_extra())
    before.require_same(stored)
    with pytest.raises(ValueError, match=f"was trained with {what}: go on"):
        now.require_same(stored)


def test_weights_to_start_from_beside_a_run_to_go_on_from_are_those_it_began_with(
    spectra_file, halfway, tmp_path, caplog
):
    often, start = "callbacks.checkpoint.interval=10", f"init_from={halfway.checkpoints[0]}"
    with caplog.at_level("WARNING"):
        train(short(spectra_file, start, often), tmp_path / "begun")
    # Validation rows among them, nobody said
    assert "its model learned from these data" in caplog.text
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
    del content["sha256"]  # as of an older file: its training state has a guard of its own
    torch.save(content, tmp_path / "spoilt.ckpt")
    with pytest.raises(
        ValueError, match=rf"trainer\.{re.escape(where)}.* is NaN or infinite; resume from"
    ):
        train(short(spectra_file, f"ckpt_path={tmp_path / 'spoilt.ckpt'}"), tmp_path / "run")
    assert not (tmp_path / "run" / "learning_curve.csv").exists()


def test_settings_of_the_schedule_may_change_and_are_named(spectra_file, halfway, tmp_path, caplog):
    last = halfway.checkpoints[0].with_name("last.ckpt")
    train(short(spectra_file, "trainer.max_steps=25", f"ckpt_path={last}"), tmp_path)
    assert re.search(r"which had trainer\.max_steps=\d+ \(here 25\)", caplog.text)


def test_training_starts_from_given_weights_on_rows_of_another_campaign(
    halfway, tmp_path, monkeypatch
):
    """Another campaign's box, and with it the origin of local coordinates,
    is never quite the same.
    """
    # One step is worse than the mean, which would answer for it.
    monkeypatch.setattr(fitting, "judge_fit", lambda method, report, *unused: (method, report))
    new = spectra(tmp_path / "new.npz", rows=55)
    before = weights(halfway.checkpoints[0])
    after: dict = {}
    for name, more in {"still": FROZEN, "on": ()}.items():
        config = short(new, f"init_from='{halfway.checkpoints[0]}'", "trainer.max_steps=1", *more)
        _, objects = train(config, tmp_path / name)
        after[name] = weights(objects.checkpoints[0])
    same = [torch.equal(after["still"][k], before[k]) for k in before if k.startswith("gaussians.")]
    assert all(same) and len(same) > 3 and len(objects.data) == 55
    assert not torch.equal(after["on"]["gaussians.means"], before["gaussians.means"])


def test_settings_of_a_run_that_is_not_there_were_gone_on_with(tmp_path):
    answer = knock(
        main, "train.py", ["dataset=rfid_sim", "model=mean", f"ckpt_path={tmp_path / 'last.ckpt'}"]
    )
    assert answer.status == 1 and "no such file" in answer.err[-1]
    assert "going on" not in " ".join(answer.out + answer.err)


@pytest.fixture(scope="module")
def others(halfway, spectra_file, tmp_path_factory) -> dict[str, Path]:
    """Files that are none of `halfway`'s."""
    folder = tmp_path_factory.mktemp("others")
    files = {"rx": spectra(folder / "rx.npz", moving="rx")}
    _, nearest = train(plain(spectra_file, "nearest"), folder / "nearest")
    return files | {"model": halfway.checkpoints[0], "nearest": nearest.checkpoints[0]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["ckpt_path={model}"], r"resume from last\.ckpt instead"),
        # It was taken for an interrupted run:
        # `gsparc has not been trained: call fit() or load a checkpoint`.
        (["ckpt_path={nearest}"], r"resume from last\.ckpt instead"),
        (["ckpt_path=gone.ckpt"], r"gone\.ckpt: no such file"),
        (["init_from=none.ckpt"], r"init_from=none\.ckpt: .*no such checkpoint"),
        (["init_from={model}", "dataset.file={rx}"], "init_from=.*trained with static_end rx"),
        (
            ["init_from={model}", "model=nearest"],
            "init_from: nearest takes no weights to start from",
        ),
        (["trainer.devices=2"], "say trainer=ddp"),  # several devices need processes that end
    ],
)
def test_what_cannot_be_trained_is_refused_in_one_line(
    spectra_file, others, tmp_path, changes, message
):
    settings = brief(spectra_file, "model.refit=false")
    if "model=nearest" in changes:
        settings = [s for s in settings if not s.startswith("model.")]
    with pytest.raises(ValueError, match=message) as error:
        train(compose(*settings, *(change.format(**others) for change in changes)), tmp_path)
    assert "\n" not in str(error.value) and not (tmp_path / "model.ckpt").exists()


@pytest.mark.parametrize("name", ["model.ckpt", "last.ckpt"])
def test_the_module_of_a_checkpoint_predicts_what_gsparc_load_does(name, spectra_file, halfway):
    path = halfway.checkpoints[0].with_name(name)
    module = load_module(path)
    data = datamodule({"name": "own", "file": str(spectra_file)}).measurements
    rows = np.arange(20)
    loaded = Loaded(data, 8).use(Fold(rows, rows[:0], rows))
    trainer = Trainer(
        accelerator="cpu", logger=False, enable_progress_bar=False, enable_checkpointing=False
    )
    predicted = torch.cat(trainer.predict(module, loaded))
    expected = gsparc.load(path).spectrum(tx=data.tx[rows] + data.site.origin)
    assert predicted.shape == (20, 16, 32) and np.abs(predicted.numpy() - expected).max() < 1e-5


def test_a_method_without_a_field_has_no_module(others):
    with pytest.raises(CheckpointError, match="nearest holds no Gaussian field"):
        load_module(others["nearest"])


@pytest.mark.slow
def test_the_folder_of_a_run_is_all_it_takes_to_go_on(spectra_file, tmp_path):
    """The settings it did not name were the defaults, and each of them stood in the refusal."""
    stopped = "callbacks.stop={_target_: lost.Interrupt, step: 15}"
    begun = brief(
        spectra_file, "model.refit=false", f"+{stopped}", f"hydra.run.dir={tmp_path / 'run'}"
    )
    answer, last = knock(main, "train.py", begun), tmp_path / "run" / "last.ckpt"
    assert answer.status == 130 and answer.err[-1].endswith(f"go on with ckpt_path={last}"), answer
    assert not any("Traceback" in line for line in answer.err)
    on = (f"ckpt_path={tmp_path / 'run'}",)
    others = [f"model.emission.{name}=0.5" for name in ("init_scale", "init_bias")] + ["seed=3"]
    others += [f"model.effects.{name}=auto" for name in ("array", "phase", "power", "residual")]
    answer = knock(main, "train.py", [*on, *others, "+callbacks.stop=null"])
    assert_refused(
        answer, r"trained with seed=0 \(here 3\)(, \S+ \(here \S+\)){4} and 2 more: go on with"
    )
    assert knock(main, "train.py", [*on, "+callbacks.stop=null"]).status == 0
    resumed = checkpoint.read(tmp_path / "run" / "model.ckpt").configuration
    assert (
        resumed["dataset"]["file"] == str(spectra_file) and resumed["model"]["field"]["count"] == 40
    )
    assert resumed["seed"] == 0 and resumed["trainer"]["max_steps"] == 20
