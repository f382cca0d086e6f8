import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from gsparc.data.datamodule import MeasurementsModule, StepLoader, order, steps_per_epoch
from gsparc.data.load import LOADERS, load
from gsparc.data.own import from_arrays
from gsparc.data.splits import Fold


@pytest.fixture
def data(csi_arrays):
    return from_arrays(csi_arrays)


FOLD = Fold(train=np.arange(9), val=np.array([9]), test=np.array([10, 11]))


def test_order_shows_every_row_once_an_epoch():
    pool = np.array([3, 5, 8, 13, 21, 34, 55])
    assert steps_per_epoch(7, 3) == 3
    for epoch in range(3):
        rows = np.concatenate([order(1, 3 * epoch + i, 3, pool) for i in range(3)])
        np.testing.assert_array_equal(np.sort(rows), pool)
    assert not np.array_equal(order(1, 0, 7, pool), order(1, 1, 7, pool))
    assert not np.array_equal(order(1, 0, 7, pool), order(2, 0, 7, pool))
    np.testing.assert_array_equal(order(1, 41, 3, pool), order(1, 41, 3, pool))


def test_order_is_pinned():
    """A change here breaks the resuming of every stored run."""
    assert order(0, 0, 4, np.arange(8)).tolist() == [2, 4, 3, 6]
    assert order(0, 3, 4, np.arange(8)).tolist() == [0, 4, 2, 5]


def test_loader_starts_where_it_is_told(data):
    whole = [b.index.tolist() for b in StepLoader(data, FOLD.train, 4, seed=0)]
    rest = [b.index.tolist() for b in StepLoader(data, FOLD.train, 4, seed=0, first_step=lambda: 2)]
    assert len(whole) == 3 and rest == whole[2:]
    second = [b.index.tolist() for b in StepLoader(data, FOLD.train, 4, seed=0, first_step=lambda: 3)]
    assert len(second) == 3 and second != whole


def test_empty_pool_is_refused(data):
    with pytest.raises(ValueError, match="training rows"):
        StepLoader(data, np.array([], dtype=np.int64), 4, seed=0)


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


def _fit(data, tmp_path, model, steps, ckpt=None, every=None):
    callbacks = []
    if every:
        callbacks = [
            pl.callbacks.ModelCheckpoint(tmp_path, "{step}", save_top_k=-1, every_n_train_steps=every)
        ]
    trainer = pl.Trainer(
        max_steps=steps, accelerator="cpu", logger=False, callbacks=callbacks,
        enable_checkpointing=bool(every), enable_progress_bar=False, enable_model_summary=False,
        default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(model, MeasurementsModule(data, FOLD, 4, seed=7), ckpt_path=ckpt, weights_only=False)
    return trainer


def test_resume_in_the_middle_of_an_epoch_continues_exactly(data, tmp_path):
    whole = _Recorder()
    _fit(data, tmp_path, whole, steps=10, every=1)
    assert whole.seen == [order(7, s, 4, FOLD.train).tolist() for s in range(10)]
    for step in (1, 2, 3, 4, 5, 7):
        resumed = _Recorder()
        _fit(data, tmp_path, resumed, steps=10, ckpt=tmp_path / f"step={step}.ckpt")
        assert resumed.seen == whole.seen[step:], f"resumed at step {step}"


def test_resume_from_a_checkpoint_saved_by_hand(data, tmp_path):
    model = _Recorder()
    trainer = _fit(data, tmp_path, model, steps=5)
    trainer.save_checkpoint(tmp_path / "hand.ckpt")
    resumed = _Recorder()
    _fit(data, tmp_path, resumed, steps=9, ckpt=tmp_path / "hand.ckpt")
    assert resumed.seen == [order(7, s, 4, FOLD.train).tolist() for s in range(5, 9)]


def test_typos_of_dataset_kinds_get_the_nearest_name():
    for typo, name in (("rfdi", "rfid"), ("newerf", "newrf"), ("rfid-sim", "rfid_sim"), ("owm", "own")):
        with pytest.raises(ValueError, match=f"did you mean '{name}'"):
            load({"name": typo})
    with pytest.raises(ValueError, match=r"dataset\.file is not set"):
        load({"name": "own"})


def test_every_loader_has_a_config_and_back():
    from importlib.resources import files

    from omegaconf import OmegaConf

    folder = files("gsparc.conf").joinpath("dataset")
    named = {OmegaConf.create(f.read_text()).name for f in folder.iterdir() if f.name.endswith(".yaml")}
    assert set(LOADERS) <= named
