"""`train()` and its command, end to end on files of a second."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest
from campaigns import brief, compose, plain, short
from doors import knock

from gsparc.base.limits import SettingError
from gsparc.commands.train import main, train
from gsparc.evaluation.console import error_in_one_line
from gsparc.models.baselines.gp import GaussianProcess
from gsparc.runs.experiment import options
from gsparc.training import curve


def steps(folder: Path) -> list[int]:
    """Those that a learning curve has rows of, after the start."""
    return [int(row["step"]) for row in curve.read_curve(folder) if row["what"].startswith("step ")]


@pytest.mark.parametrize("more, times", [([], 1), (["model.components=3"], 2)])
def test_a_method_with_the_settings_of_a_baseline_is_fitted_once(
    more, times, spectra_file, tmp_path, monkeypatch
):
    fits, fit = [], GaussianProcess.fit
    monkeypatch.setattr(GaussianProcess, "fit", lambda *given: fits.append(1) or fit(*given))
    facts, _ = train(plain(spectra_file, "gp", "baselines=[gp]", *more), tmp_path)
    assert len(fits) == times
    assert (facts["test/psnr_db"] == facts["baseline/gp/psnr_db"]) == (times == 1)


def test_sectors_were_drawn_where_there_are_test_rows_alone(spectra_file, tmp_path, monkeypatch):
    drawn = []
    drawing = "gsparc.pictures.pictures.draw_sector_levels"
    monkeypatch.setattr(drawing, lambda *of: drawn.append(of[-1].name))
    train(plain(spectra_file, "gp", "baselines=[]", "split=none"), tmp_path)
    assert drawn == ["sectors.png"]


def test_folds_have_folders_and_are_pooled(spectra_file, tmp_path):
    config = plain(spectra_file, "mean", "split=grouped", "split.folds=2", "split.buffer_m=0")
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


def test_files_in_a_list_were_an_error_of_their_path(tmp_path):
    with pytest.raises(SettingError, match="expected one file; join tables first"):
        words = "dataset=own", "dataset.file=[a.csv,b.csv]", "model=mean", "logger=none"
        train(compose(*words), tmp_path / "run")


def test_the_simulated_stand_in_says_so(tmp_path):
    settings = [s for s in brief(tmp_path) if not s.startswith(("dataset", "model."))]
    chosen = "dataset=rfid_sim", "dataset.count=30", f"dataset.root={tmp_path}", "model=mean"
    facts, _ = train(compose(*settings, *chosen), tmp_path / "run")
    assert facts["dataset/name"] == "rfid-sim" and facts["dataset/stand_in"]


# -- options of the Trainer, and Lightning's own way to a model ------------------------------------


@pytest.mark.parametrize(
    ("options", "validated"),
    [
        (["trainer=debug"], [1]),
        (["trainer.precision=bf16-mixed", "+trainer.profiler=simple"], [10, 20]),
        (["trainer.gradient_clip_val=1.0", "trainer.val_check_interval=7"], [7, 14]),
    ],
)
def test_an_option_of_the_trainer_is_an_override(
    options, validated, spectra_file, tmp_path, caplog
):
    caplog.set_level(logging.INFO)
    facts, _ = train(short(spectra_file, *options), tmp_path)
    assert facts["test/psnr_db"] > 20 and steps(tmp_path) == validated
    assert ("FIT Profiler Report" in caplog.text) == ("+trainer.profiler=simple" in options)


def test_tensorboard_that_is_not_there_is_one_line(spectra_file, tmp_path, monkeypatch):
    """It was, but only after the data were read."""
    monkeypatch.setattr("gsparc.training.tracking.find_spec", lambda name: None)
    monkeypatch.setattr("gsparc.runs.inputs.datamodule", None)
    folders = [f"logger.{name}.save_dir='{tmp_path}'" for name in ("csv", "tensorboard")]
    with pytest.raises(ValueError, match="TensorBoard is not installed") as error:
        train(compose(*brief(spectra_file), "logger=tensorboard", *folders), tmp_path)
    message = "logger=tensorboard: TensorBoard is not installed; say pip install"
    assert error_in_one_line(error.value).startswith(message)


def test_the_curve_of_a_closed_form_had_no_held_out_error(spectra_file, tmp_path):
    train(plain(spectra_file, "nearest"), tmp_path)
    (row,) = curve.read_curve(tmp_path)
    told = json.loads((tmp_path / "summary.json").read_text())
    assert row["what"] == "test rows" and float(row["error"]) == pytest.approx(told["test/mse"])


def test_options_without_effect_are_said_and_stored(spectra_file, tmp_path, monkeypatch, caplog):
    """`effects.array=true effort=.5`, or `trainer.max_steps=3` of a plain method,
    went without a word.
    """
    given = {name: f"{name}=3" for name in ("trainer.max_steps", "effort", "seed")}
    monkeypatch.setattr(options, "command_line_options", lambda: given)
    train(plain(spectra_file, "nearest"), tmp_path)
    stored = json.loads((tmp_path / "summary.json").read_text())
    assert {"git", "versions", "memory/peak_mb", "time/train_s", "seed"} <= set(stored)
    assert stored["options/unused"] == "trainer.max_steps=3, effort=3"
    (record,) = [r for r in caplog.records if "without effect" in r.message]
    assert record.levelno == logging.WARNING and "(nearest counts nothing)" in record.message


# -- the objective of a search ---------------------------------------------------------------------


def test_the_folder_of_one_run_was_ignored_in_a_sweep(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = f"hydra.run.dir={tmp_path / 'mine'}"
    answer = knock(main, "train.py", ["-m", "seed=0,1", "dataset=rfid_sim", "model=mean", folder])
    assert answer.status == 1 and "say hydra.sweep.dir=FOLDER" in "".join(answer.out)
    assert not (tmp_path / "mine").exists()


@pytest.mark.slow
@pytest.mark.parametrize("way", [(), ("-m", "seed=0,1")], ids=["a run", "a sweep"])
def test_the_objective_is_for_searches_alone(tmp_path, way):
    """One channel of sixty is not silent: everything was written, then
    `error: objective=test/nmse`, exit 1.
    """
    where, heard = np.random.default_rng(0).uniform(0, 20, (60, 3)), np.zeros(60, complex)
    heard[7] = 1.0
    ends = {"rx_position": where, "tx_position": np.zeros(3), "frequency_hz": 1e9}
    np.savez(tmp_path / "own.npz", csi=heard, **ends)
    folder = [f"hydra.run.dir={tmp_path / 'run'}", f"hydra.sweep.dir={tmp_path / 'run'}"]
    given = ["dataset=own", f"dataset.file={tmp_path / 'own.npz'}", "model=mean", "baselines=[]"]
    answer = knock(
        main, "train.py", [*way, *given, *folder, "logger=none", "threads=1", "split.seed=0"]
    )
    assert answer.status == 0 and not [line for line in answer.err if line.startswith("error")], (
        answer
    )
    written = list((tmp_path / "run").glob("*/summary.json" if way else "summary.json"))
    assert len(written) == (2 if way else 1)
    assert all(json.loads(file.read_text())["test/nmse"] is None for file in written)
    assert not way or (tmp_path / "run" / "sweep.png").exists()  # of no figure at all: no logarithm


def said_of_a_draw(folder: Path, **rows: np.ndarray) -> str:
    """The log of a training on split.seed=2 of a file with those `rows`."""
    places, file = np.random.default_rng(0).uniform(0, 20, (60, 3)), folder / "own.npz"
    np.savez(
        file, rx_position=places, tx_position=np.zeros(3), rssi_db=-50.0 - places[:, 0], **rows
    )
    given = ["dataset=own", f"dataset.file={file}", "model=mean", "baselines=[]", "split.seed=2"]
    given += [f"hydra.run.dir={folder / 'run'}", "logger=none", "threads=1"]
    assert knock(main, "train.py", given).status == 0
    return " ".join((folder / "run/train.log").read_text().split())


def test_the_title_of_a_table_did_not_say_the_draw_of_the_split(tmp_path):
    """`split random, test, seed 0` stood above three draws."""
    assert "random (split.seed=2), test, seed 0" in said_of_a_draw(tmp_path)


def test_the_title_named_a_seed_where_the_release_named_the_test_rows(tmp_path):
    """`split random (split.seed=2)`, and the seed had moved validation rows alone."""
    said = said_of_a_draw(tmp_path, split_train=np.arange(40), split_test=np.arange(40, 60))
    assert "split random (test rows named by its files), test, seed 0" in said
    assert (
        "random (test rows named by its files): 36 training"
    ) in said and "(split.seed" not in said
