"""One wrong training row, for every method: refused or finite; left out,
as if it had never been.
"""

import numpy as np
import pytest
import torch
from campaigns import channels, powers, spectra

from gsparc.datasets.load import load, split_for
from gsparc.models.registry import method_class
from gsparc.training.context import FitContext

MAKERS = {"spectrum": spectra, "csi": channels, "rssi_db": powers}
QUICK = {  # methods by what they serve, none of which trains for a fixed time
    "spectrum": ("zero", "mean", "nearest", "idw", "gp"),
    "csi": ("zero", "mean", "nearest", "idw", "gp", "complex_gp"),
    "rssi_db": ("zero", "mean", "nearest", "idw", "gp", "kriging", "distance_law"),
}
WRONG = {
    "power": lambda arrays, kind: arrays[kind].__setitem__(7, loudest(arrays[kind], kind)),
    "place": lambda arrays, kind: arrays[moving(arrays)].__setitem__(7, [3e6, 0, 0]),
}


def loudest(values, kind):
    return values[7] + 80 if kind == "rssi_db" else values[7] * 1e8


def moving(arrays):
    return next(name for name in ("tx_position", "rx_position") if np.ndim(arrays[name]) == 2)


def cases():
    return [
        (kind, name, wrong) for kind, names in QUICK.items() for name in names for wrong in WRONG
    ]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A sound file of each kind, and the same with row 7 wrong in each way."""
    folder, found = tmp_path_factory.mktemp("wrong"), {}
    for kind, make in MAKERS.items():
        found[kind, None] = make(folder / f"{kind}.npz")
        for name, spoil in WRONG.items():
            with np.load(found[kind, None]) as stored:
                arrays = {key: stored[key].copy() for key in stored.files}
            spoil(arrays, kind)
            found[kind, name] = folder / f"{kind}-{name}.npz"
            np.savez(found[kind, name], **arrays)
    return found


def answers(file, name, tmp_path, leave_out):
    """Predictions at the test rows in physical units, of a split that never tests row 7."""
    data = load({"name": "own", "file": str(file)})
    fold = split_for({"name": "random", "seed": 1, "leave_out": leave_out}, data).folds[0]
    method = method_class(name)()
    method.fit(data, fold, FitContext(tmp_path))
    return method.predict(data.batch(np.setdiff1d(fold.test, [7]))).mean * data.site.target_scale


@pytest.mark.slow
@pytest.mark.parametrize("kind,name,wrong", cases())
def test_left_out_it_had_never_been_and_kept_it_is_finite_or_refused(
    files, tmp_path, kind, name, wrong
):
    spoilt = answers(files[kind, wrong], name, tmp_path, "outliers")
    sound = answers(files[kind, None], name, tmp_path, [7])
    assert torch.isfinite(sound).all()
    assert torch.allclose(spoilt, sound, rtol=1e-4, atol=1e-5 * float(sound.abs().max()))
    try:
        found = answers(files[kind, wrong], name, tmp_path, ())
    except ValueError as refused:
        assert "\n" not in str(refused)
    else:
        assert torch.isfinite(found).all()
