"""Configurations with a slip of the finger at any depth: the nearest right name,
before anything is computed.

Remedy: gsparc/base/limits.py (what a setting may be),
gsparc/commands/shared/cli.py (one line, nearest name).
"""

import pytest
from campaigns import spectra
from doors import assert_refused, knock

from gsparc.commands.train import main as train

SLIPS = {
    "modle=gsparc": "did you mean 'model'",
    "model=gsprac": "did you mean 'gsparc'",
    "experiment=paper/rfdi": "experiment=paper/rfdi: no such choice; did you mean 'paper/rfid'",
    "experiment=papr/rfid": "did you mean 'paper/rfid'",
    "experiment=paperrfid": "did you mean 'paper/rfid'",
    "trainer.max_step=3": "did you mean 'trainer.max_steps'",
    "model.field.cout=4": "did you mean 'model.field.count'",
    "model.feild.count=4": "did you mean 'model.field'",
    "model.emission.encoding.octavs=3": "did you mean 'model.emission.encoding.octaves'",
    "callbacks.pictres.every=1": "did you mean 'callbacks.pictures'",
    "+model.field.cout=3": "model.field.cout: no such setting of FieldSettings; did you mean "
    "'model.field.c",
    "++model.emission.encoding.octavs=3": "of EncodingSettings; did you mean "
    "'model.emission.encoding.oct",
    "hydra.run.dri=x": "did you mean 'hydra.run.dir'",
    "dataset.flie=x": "did you mean 'dataset.file'",
    "dataset.name=onw": "did you mean 'own'",
    "split.val_fracton=0.1": "did you mean 'split.val_fraction'",
    "eval_on=tset": "eval_on='tset': one of train, val, test is needed; did you mean 'test'",
    "baselines=[gpp]": "'gpp' is none; did you mean 'gp'",
    "lr=0.1": "lr: no such setting",
}
VALUES = {
    "seed=abc": "seed='abc': a whole number of at least 0",
    "seed=-1": "seed=-1: a whole number",
    "effort=1min": "effort='1min': a number above 0 is needed",
    "trainer.accelerator=gpu": "trainer.accelerator=gpu: there is no GPU here; say trainer=cpu",
    "threads=0": "threads=0: a whole number of at least 1, or null",
    "baselines=gp": "a list of methods is needed",
    "ckpt_path=missing.ckpt": "ckpt_path=missing.ckpt: no such file",
    "trainer.max_steps=-2": "trainer.max_steps=-2: a whole number of at least 0",
    "dataset.batch_size=true": "dataset.batch_size=True",
    "trainer.gradient_clip_val=-1": "trainer.gradient_clip_val=-1: a number above 0",
    "trainer.accelerator=gpuu": "accelerator='gpuu'",
    "model.field.count=-3": "model.field.count=-3",
    "model.field.opacity=1": "model.field.opacity=1: a number above 0 and below 1",
    "model.field.scale=-0.1": "model.field.scale=-0.1",
    "model.field.margin=inf": "model.field.margin=inf",
    "init=spere": "did you mean 'sphere'",
    "model.emission.activation=sigmoide": "did you mean 'sigmoid'",
    "model.emission.hidden=-1": "model.emission.hidden=-1",
    "model.emission.encoding.kind=kernal": "model.emission.encoding.kind='kernal'",
    "model.emission.encoding.anchors=0": "anchors=0",
    "model.attenuation.d_min=0": "model.attenuation.d_min=0: a number above 0",
    "model.attenuation.gain=-2": "model.attenuation.gain=-2",
    "model.attenuation.d_ref=nan": "model.attenuation.d_ref=nan",
    "model.raster.projection=tangents": "'tangent' or 'equirect'",
    "model.raster.backend=gpu": "'reference', 'cpu' or 'cuda'",
    "model.raster.low_pass=-1": "low_pass >= 0",
    "model.raster.alpha_cutoff=2": r"cut-offs lie in \(0, 1\)",
    "model.loss.ssim_weight=nan": "model.loss.ssim_weight=nan",
    "model.optimizer.positions=-1": "model.optimizer.positions=-1: a number of at least 0",
    "model.optimizer.emission=inf": "model.optimizer.emission=inf",
    "model.confidence.alpha=-1": "model.confidence.alpha=-1",
    "model.confidence.clamp=1e4": "at most 80",
    "model.effects.phase=ture": "one of true, false, auto",
    "model.effects=off": "one by one: model.effects.image=..., model.effects.array=...",
    "model.init=sources": "say init=sources",
    "callbacks.densify=off": "null leaves it out",
    "init.name=maybe": "one of auto, sphere",
    "model.refit=perhaps": "one of true, false",
    "model._target_=os.system": "'os.system'",
    "split.val_fraction=2": "split.val_fraction=2",
    "split.test_fraction=0": "split.test_fraction=0",
    "split.thin=-1": "split.thin=-1",
    "dataset.file=": "dataset.file is not set",
    "trainer.max_steps": "trainer.max_steps: not understood; write KEY=VALUE",
    "=": "Could not override",
}
CASES = {**SLIPS, **VALUES}
QUICK = (
    "modle=gsparc",
    "experiment=paper/rfdi",
    "model.emission.encoding.octavs=3",
    "+model.field.cout=3",
    "seed=abc",
    "model.attenuation.d_min=0",
    "eval_on=tset",
    "model.effects=off",
)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return spectra(tmp_path_factory.mktemp("doors") / "own.npz")


@pytest.mark.parametrize(
    "slip", [s if s in QUICK else pytest.param(s, marks=pytest.mark.slow) for s in CASES]
)
def test_train(slip, file, tmp_path):
    good = [
        *(
            "dataset=own",
            f"dataset.file={file}",
            f"hydra.run.dir={tmp_path}",
            "logger=none",
            "threads=1",
        ),
        *(
            "baselines=[]",
            "trainer.max_steps=1",
            "model.field.count=5",
            "model.effects.phase=false",
        ),
    ]
    assert_refused(knock(train, "train.py", [*good, slip]), CASES[slip], tmp_path)
