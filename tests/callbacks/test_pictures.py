from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsparc.callbacks import Pictures
from gsparc.callbacks.pictures import draw_spectra
from gsparc.evaluation.examples import Examples
from gsparc.pictures.drawing import save


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


def test_the_worst_prediction_is_the_most_colourful(tmp_path):
    """The third column shows the difference: nothing to see where there is none."""
    target = np.linspace(0, 1, 12 * 24).reshape(1, 12, 24)
    colours = []
    for name, predicted in (("good", target), ("bad", 1 - target)):
        own, edges = {"predicted": predicted}, np.array([0, 360, 0, 90])
        shown = Examples(np.array([3]), edges, target, np.array([np.nan]), own)
        save(draw_spectra(shown, "title"), tmp_path / f"{name}.png")
        with Image.open(tmp_path / f"{name}.png") as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        third = pixels[: pixels.shape[0] // 2, 2 * pixels.shape[1] // 3 :]  # above the colour bar
        colours.append(np.abs(third.max(-1) - third.min(-1)).mean())
    assert colours[1] > 3 * colours[0]
