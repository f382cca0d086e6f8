from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from campaigns import compose

import gsparc.conf
from gsparc.data.splits import Fold
from gsparc.datasets.datamodule import DataModule, Loaded, StepLoader, rows_of_step, steps_per_epoch
from gsparc.datasets.load import datamodule
from gsparc.tables.own import from_arrays


@pytest.fixture
def data(csi_arrays):
    return from_arrays(csi_arrays)


FOLD = Fold(train=np.arange(9), val=np.array([9]), test=np.array([10, 11]))


def test_order_shows_every_row_once_an_epoch():
    pool = np.array([3, 5, 8, 13, 21, 34, 55])
    assert steps_per_epoch(7, 3) == 3
    for epoch in range(3):
        rows = np.concatenate([rows_of_step(1, 3 * epoch + i, 3, pool) for i in range(3)])
        np.testing.assert_array_equal(np.sort(rows), pool)
    assert not np.array_equal(rows_of_step(1, 0, 7, pool), rows_of_step(1, 1, 7, pool))
    assert not np.array_equal(rows_of_step(1, 0, 7, pool), rows_of_step(2, 0, 7, pool))
    np.testing.assert_array_equal(rows_of_step(1, 41, 3, pool), rows_of_step(1, 41, 3, pool))


def test_order_is_pinned():
    """A change here breaks the resuming of every stored run."""
    assert rows_of_step(0, 0, 4, np.arange(8)).tolist() == [2, 4, 3, 6]
    assert rows_of_step(0, 3, 4, np.arange(8)).tolist() == [0, 4, 2, 5]


class _Recorder(pl.LightningModule):
    def __init__(self, stop_after=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen, self.stop_after = [], stop_after

    def training_step(self, batch, _):
        self.seen.append(batch.index.tolist())
        if len(self.seen) == self.stop_after:
            raise KeyboardInterrupt
        return self.weight * batch.target.abs().mean()

    def validation_step(self, batch, _):
        pass

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def _fit(module, tmp_path, model, steps, ckpt=None, every=None):
    kept = pl.callbacks.ModelCheckpoint(
        tmp_path, "{step}", save_top_k=-1, every_n_train_steps=every
    )
    trainer = pl.Trainer(
        max_steps=steps,
        accelerator="cpu",
        logger=False,
        callbacks=[kept] if every else [],
        enable_checkpointing=bool(every),
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=tmp_path,
    )
    trainer.fit(model, module, ckpt_path=ckpt, weights_only=False)
    return trainer


def test_resume_in_the_middle_of_an_epoch_continues_exactly(data, tmp_path):
    whole, module = _Recorder(), Loaded(data, 4).use(FOLD, seed=7)
    _fit(module, tmp_path, whole, steps=10, every=1)
    assert whole.seen == [rows_of_step(7, s, 4, FOLD.train).tolist() for s in range(10)]
    for step in (1, 2, 3, 4, 5, 7):
        resumed = _Recorder()
        _fit(module, tmp_path, resumed, steps=10, ckpt=tmp_path / f"step={step}.ckpt")
        assert resumed.seen == whole.seen[step:], f"resumed at step {step}"


TYPOS = {"rfdi": "rfid", "newerf": "newrf", "rfid-sim": "rfid_sim", "owm": "own"}
CONFIGS = {
    path.stem: path for path in Path(gsparc.conf.__path__[0]).joinpath("dataset").glob("*.yaml")
}
del CONFIGS["fingerprints"]  # of `gsparc locate` alone


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_every_config_names_a_data_module_of_its_own(name):
    stored = {"name": name} | ({"file": "x.npz"} if "\nfile:" in CONFIGS[name].read_text() else {})
    module = datamodule(
        compose(f"dataset={name}", *(f"dataset.{k}={v}" for k, v in stored.items())).dataset
    )
    assert isinstance(module, DataModule) and type(module).__module__.startswith("gsparc.")
    assert (module.name, module.batch_size) == (name, 16)
    short = datamodule(stored, trusted=False)
    assert type(short) is type(module) and vars(short).keys() == vars(module).keys()
    for key in ("root", "file", "settings", "selection", "stand_in"):
        assert getattr(short, key, None) == getattr(module, key, None)


NO_MODULE = "is no gsparc.datasets.datamodule.DataModule"


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            {"name": "own", "_target_": "os.system"},
            "no gsparc.datasets.datamodule.DataModule|no such setting",
        ),
        ({"name": "own", "_target_": "gsparc.models.baselines.mean.Mean"}, NO_MODULE),
        ({"name": "own", "_target_": "gsparc.datasets.own.Onw"}, NO_MODULE),
        ({"name": "own", "_target_": "gsparc.datasets.rfid.RFID"}, "this is dataset=rfid; say"),
        ({"name": "fingerprints", "file": "x.npz"}, "DataModule; only gsparc locate takes it"),
        ({"name": "rfid", "gatway": "x"}, "dataset.gatway: no such setting .*mean .gateway."),
        (
            {"name": "own", "file": "x", "batch_size": 0},
            "dataset.batch_size=0: a whole number of at least 1",
        ),
        *(({"name": typo}, f"did you mean '{name}'") for typo, name in TYPOS.items()),
        ({"name": "own"}, "dataset.file is not set"),
        (
            {"name": "ble", "root": "x"},
            "dataset.root is not a setting of dataset=ble; say dataset.file=...",
        ),
    ],
)
def test_what_is_no_dataset_is_refused_in_one_line(refused, settings, says):
    refused(says, datamodule, settings)


def test_text_out_of_a_file_names_classes_of_gsparc_only():
    foreign = {"_target_": f"{__name__}.Mine", "name": "mine"}
    with pytest.raises(ValueError, match="not a class of gsparc; refused"):
        datamodule(foreign, trusted=False)
    nested = {"name": "rfid", "stand_in": {"_target_": "os.system", "command": "true"}}
    with pytest.raises(ValueError, match=r"'os\.system', which is not a class"):
        datamodule(nested, trusted=False)


class Mine(DataModule):
    """A dataset of a user's own, outside gsparc."""

    reads = 0

    def __init__(self, arrays, name="mine", batch_size=4):
        super().__init__(name, batch_size)
        self.arrays = arrays

    def load(self):
        Mine.reads += 1
        return from_arrays(self.arrays)


def test_a_subclass_needs_load_alone(csi_arrays, tmp_path):
    module = Mine(csi_arrays)
    with pytest.raises(RuntimeError, match=r"use\(fold, seed\)"):
        module.train_dataloader()
    recorder = _Recorder()
    _fit(module.use(FOLD, seed=3), tmp_path, recorder, steps=2)
    assert (
        recorder.seen == [rows_of_step(3, s, 4, FOLD.train).tolist() for s in range(2)]
        and Mine.reads == 1
    )
    assert [b.index.tolist() for b in module.test_dataloader()] == [FOLD.test.tolist()]


@pytest.mark.parametrize(("batch", "devices"), [(4, 2), (3, 2), (1, 2), (2, 3)])
def test_shares_of_a_step_add_up_to_one(data, batch, devices):
    loaders = [
        StepLoader(data, FOLD.train, batch, 0, rank=r, devices=devices) for r in range(devices)
    ]
    for parts in zip(*loaders, strict=True):
        assert sum(part.share for part in parts) == pytest.approx(1)
        counted = sum(len(part) for part in parts if part.share)
        assert all(part.share in (0, pytest.approx(len(part) / counted)) for part in parts)
        assert parts[-1].to("cpu").share == parts[-1].share
