from types import SimpleNamespace

import numpy as np
import pytest

from gsparc.callbacks import Pictures


def stage(data, fold, run_dir, step):
    def predict(tx, rx):
        return SimpleNamespace(mean=data.targets(np.arange(len(tx))))

    model = type(
        "Model", (), {"site": data.site, "__call__": lambda self, tx, rx: predict(tx, rx)}
    )()
    module = SimpleNamespace(
        mean=lambda batch: predict(batch.tx, batch.rx).mean,
        site=model.site,
        run_dir=run_dir,
        device="cpu",
        total_steps=25,
    )
    loaded = SimpleNamespace(measurements=data, fold=fold)
    trainer = SimpleNamespace(
        global_step=step,
        max_steps=25,
        datamodule=loaded,
        callbacks=[],
        loggers=[],
        is_global_zero=True,
    )
    return trainer, module


@pytest.mark.parametrize(("step", "drawn"), [(11, False), (25, True)])
def test_now_and_then_and_at_the_end(campaign, folds, tmp_path, step, drawn):
    data = campaign("spectrum")
    run, module = stage(data, folds(len(data)).folds[0], tmp_path, step)
    Pictures(every=10, count=2).on_train_batch_end(run, module)
    assert (tmp_path / "pictures" / f"step_{step:06d}.png").exists() == drawn


@pytest.mark.parametrize(("kind", "validation"), [("spectrum", 0), ("csi", None)])
def test_neither_training_rows_nor_channels_are_drawn(campaign, folds, tmp_path, kind, validation):
    data = campaign(kind)
    fold = folds(len(data)).folds[0]
    run, module = stage(
        data, type(fold)(fold.train, fold.val[:validation], fold.test), tmp_path, 25
    )
    Pictures(every=5, count=200).on_train_batch_end(run, module)
    assert not list(tmp_path.iterdir())
