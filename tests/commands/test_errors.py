"""What a command refuses: one line that says what is wrong, status 1, nothing half-written."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from doors import assert_refused, knock
from towns import town_model

from gsparc.commands.listing import COMMANDS

MAP = "map ckpt={town}"
LOCATE = "locate calibrate=0 ckpt={spectra}"
PRINTS = "locate calibrate=0 dataset=fingerprints"
HALL = f"{PRINTS} dataset.split=walks dataset.file={{prints}}/walks.npz"
COMPARE = "compare +datasets.own.file={file} splits.random.datasets=[own] cells={folder}/cells"
REFUSED = [
    ("study kind=efects", "kind=efects: no such choice; did you mean 'effects'?"),
    ("train baselines=[gpp]", "baselines=['gpp']: a list of methods is needed, 'gpp' is none"),
    ("train model.field.count=-1", "model.field.count=-1: a whole number of at least 0"),
    ("study variant=plian", "variant=plian: no such choice; did you mean 'plain'?"),
    ("train disturb.keep=0 dataset.file={file} dataset=own", "disturb.keep=0: a number above 0"),
    # No rounds ended in an IndexError, no draws in a maximum of nothing.
    ("tradeoff ckpt={spectra} rounds=0", "rounds=0: a whole number of at least 1"),
    ("calibrate ckpt={town} draws=0", "draws=0: a whole number of at least 1"),
    ("evaluate ckpt=none.ckpt", "none.ckpt: no such checkpoint"),
    ("evaluate ckpt=absent.ckpt eval_onn=val", "did you mean 'eval_on'"),
    ("evaluate ckpt=absent.ckpt eval_on=vall", "did you mean 'val'"),
    ("evaluate ckpt=absent.ckpt threads=-2", "threads=-2"),
    ("evaluate ckpt=absent.ckpt baselines=[nearst]", "did you mean 'nearest'"),
    # Lightning's words on lengths of loaders, then a normal fit.
    (
        "train model=gp dataset=own dataset.file={file} trainer.overfit_batches=2",
        "not supported; split.train_count",
    ),
    ("train -m model=gp,idw --cfg job", "--cfg shows one job: leave out -m"),
    ("report", "no run is named; say gsparc report RUN..., folders of runs"),
    ("serve ckpt=none.ckpt host=0.0.0.0", "others reach it; set GSPARC_TOKEN, or say token=WORD"),
    ("serve ckpt=none.ckpt host=example.org", "others reach it"),
    # Without baselines it was an AttributeError, after every combination had been made.
    (
        "tradeoff ckpt={spectra} baselines=[] eval_on=tset",
        "eval_on='tset' is none of train, val, test",
    ),
    (f"{COMPARE} only=[own/random/meen/*]", "matches no cell"),
    (f"{COMPARE} only=[own/random/mean/*] train=false", "no cell is filled"),
    (f"{MAP} step_m=0", "step_m=0: a number above 0"),
    (f"{MAP} plan_points=[[0,0,0,0],[1,1,1,1]]", "goes with an image"),
    (f"{MAP} promise.share=1.5", "share=1.5"),
    (f"{MAP} dataset.file=gone.npz renew=true", "gone.npz"),
    # As of all nine that open data: settings beside name, root and file were refused,
    # and unknown ones are.
    (
        f"{MAP} dataset.nonsense=1 promised=false",
        "dataset.nonsense: no such setting of dataset=own",
    ),
    ("view ckpt={town} save=page.html dataset.nonsense=1", "dataset.nonsense: no such setting"),
    ("calibrate ckpt={town} dataset.nonsense=1", "dataset.nonsense: no such setting"),
    ("plan ckpt={town} count=0", "at least 1"),
    ("place ckpt={town}", "train with stations=together"),
    ("locate calibrate=0", "ckpt is not set"),
    ("locate calibrate=0 ckpt=none.ckpt", "none.ckpt: no such checkpoint"),
    (f"{LOCATE} prior=wall", "prior='wall': one of box, trained is needed"),
    (f"{LOCATE} share=1.5", "share=1.5: a number above 0 and below 1"),
    (f"{LOCATE} offset_db=-1", "offset_db=-1: a number of at least 0"),
    (f"{LOCATE} rows=0", "rows=0: a whole number of at least 1"),
    (f"{LOCATE} phase_known=perhaps", "phase_known='perhaps': one of true, false"),
    (f"{LOCATE} against=[wknn]", "against='wknn': one of nearest, weighted_knn"),
    (f"{LOCATE} data=none.npz", "none.npz: no such file"),
    (f"{LOCATE} data={{prints}}/walks.npz", "walks.npz"),
    (PRINTS, "give dataset.file=FILE, and no ckpt"),
    (f"{HALL} ckpt={{spectra}}", "give dataset.file=FILE, and no ckpt"),
    (f"{PRINTS} dataset.file=none.npz", "none.npz: no such file"),
    (f"{HALL} offset_db=3", "for trained models alone"),
    (f"{HALL} data={{prints}}/others.npz", "no access point of"),
    (f"{HALL} dataset.held_out=2", "dataset.held_out=2: a number above 0 and below 1"),
]


@pytest.fixture(scope="module")
def prints(fingerprints, tmp_path_factory) -> Path:
    """Fingerprints of a hall, and beside them others."""
    folder = tmp_path_factory.mktemp("prints")
    changes = {
        "walks": {},
        "others": {"access_point": np.array([f"x{name}" for name in fingerprints["access_point"]])},
    }
    for name, change in changes.items():
        np.savez(folder / f"{name}.npz", **(fingerprints | change))
    return folder


@pytest.fixture(scope="module")
def made(prints, spectra_gp, spectra_file) -> dict[str, Path]:
    """What stands in braces above; the town's model is a copy: commands keep calibrations in it."""
    town = Path(shutil.copy(town_model(), prints / "town.ckpt"))
    return {"town": town, "spectra": spectra_gp, "prints": prints, "file": spectra_file}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_what_cannot_be_done_is_one_line(line, message, made, tmp_path, monkeypatch):
    monkeypatch.delenv("GSPARC_TOKEN", raising=False)
    name, *overrides = line.format(**made, folder=tmp_path).split()
    overrides = [f"hydra.run.dir={tmp_path / 'run'}", *overrides]
    pattern = message if message.startswith("^") or ".*" in message else re.escape(message)
    assert_refused(knock(COMMANDS[name].run, name, overrides), pattern, tmp_path / "run")
