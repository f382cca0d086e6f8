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
