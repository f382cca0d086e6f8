"""One wrong training row, for every method: refused or finite; left out, as if it had never been."""

from __future__ import annotations

from shutil import copytree

import cities
import numpy as np
import pytest
import torch
from campaigns import STILL, channels, compose, powers, spectra
from contexts import short
from shoeboxes import scatter

from gsparc.data.datasets.argos import load_argos
from gsparc.data.load import load, split_for
from gsparc.data.schema import LIGHT
from gsparc.models.registry import build, method_class, methods
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import steering
from gsparc.simulate.shoebox import Room, trace_room
from gsparc.training.context import FitContext

ROOM = Room.uniform((4.0, 3.0, 2.5), -0.5)
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
    return [(kind, name, wrong) for kind, names in QUICK.items() for name in names for wrong in WRONG]


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


@pytest.mark.parametrize("kind,name,wrong", cases())
def test_left_out_it_is_as_if_it_had_never_been(files, tmp_path, kind, name, wrong):
    spoilt = answers(files[kind, wrong], name, tmp_path, "outliers")
    sound = answers(files[kind, None], name, tmp_path, [7])
    assert torch.isfinite(sound).all()
    assert torch.allclose(spoilt, sound, rtol=1e-4, atol=1e-5 * float(sound.abs().max()))


@pytest.mark.parametrize("kind,name,wrong", cases())
def test_kept_it_leaves_finite_answers_or_is_refused(files, tmp_path, kind, name, wrong):
    try:
        found = answers(files[kind, wrong], name, tmp_path, ())
    except ValueError as refused:
        assert "\n" not in str(refused)
    else:
        assert torch.isfinite(found).all()


def of_an_array(moving):
    """Spectra of four antennas in a room, as the array would measure them."""

    def made(path):
        grid, square = SphereGrid.hemisphere(9, 18), 0.25 * np.mgrid[:2, :2, :1].reshape(3, 4).T
        places = scatter(ROOM, 80, seed=0, margin=0.4)
        ends = (STILL, places) if moving == "rx" else (places, STILL)
        heard = trace_room(ROOM, *ends, np.array([3e8]), max_order=1, array=square).csi[:, :, 0]
        images = np.abs(heard @ steering(square, grid, LIGHT / 3e8).numpy().conj()).reshape(-1, 9, 18)
        facts = {"tx_position": ends[0], "rx_position": ends[1], "array_position": square, "carrier_hz": 3e8}
        np.savez(path, spectrum=images / images.max(), **facts)
        return path

    return made


def with_directions(path):
    """Channels of one antenna, and where each of the room's first images lies."""
    walls = np.array([[0, 0, 0], [4, 3, 2.5]])
    images = [STILL] + [
        np.where(np.arange(3) == axis, 2 * wall - STILL, STILL) for axis in range(3) for wall in walls
    ]
    with np.load(channels(path, shape="S")) as stored:
        arrays = dict(stored)
    rays = (np.array(images)[None] - arrays["rx_position"][:, None]).reshape(-1, 3)
    arrays["path_direction"] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    arrays["path_offsets"] = np.arange(0, len(rays) + 1, len(images))
    np.savez(path, **arrays)
    return path


SLOW = {  # of data: what makes them, their kind, the methods that train or search there
    "spectra": (
        spectra, "spectrum", ("gsrf", "wrfgs", "swiftwrf", "nerf2", "splat", "image_process", "gsparc"),
    ),
    "spectra of a known array": (of_an_array("tx"), "spectrum", ("array", "array_process", "ngrf", "gsparc")),
    "spectra of a moving array": (
        of_an_array("rx"), "spectrum", ("moving_array", "bearings", "gsparc"),
    ),
    "channels": (channels, "csi", ("gsrf", "ngrf", "image_source_gp", "image_sources", "channels", "gsparc")),
    "channels with directions": (with_directions, "csi", ("newrf", "directional_gp", "gsparc")),
    "powers": (powers, "rssi_db", ("powers", "gsparc")),
}  # fmt: skip
UPLINK = ("ridge", "fire", "uplink")


def trained(name, data, fold, folder):
    """Test predictions after half a second of training."""
    config = compose(f"model={name}", "budget_s=0.5", *(["model.max_steps=20"] if name == "fire" else []))
    method = build(config.model).create_for(data)
    method.fit(data, fold, short(folder, 4, budget_s=0.5))
    return method.predict(data.batch(fold.test)).mean


def finite_or_refused(name, data, fold, folder):
    try:
        found = trained(name, data, fold, folder)
    except ValueError as refused:
        assert "\n" not in str(refused)
    else:
        assert torch.isfinite(found).all()


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [None, *WRONG])
@pytest.mark.parametrize("what,name", [(what, name) for what in SLOW for name in SLOW[what][2]])
def test_trained_methods_stay_finite_or_refuse(tmp_path, what, name, wrong):
    make, kind, _ = SLOW[what]
    file = make(tmp_path / "sound.npz")
    if wrong:
        with np.load(file) as stored:
            arrays = {key: stored[key].copy() for key in stored.files}
        WRONG[wrong](arrays, kind)
        np.savez(file, **arrays)
    data = load({"name": "own", "file": str(file)})
    fold = split_for({"name": "random", "seed": 1}, data).folds[0]
    assert wrong is None or 7 in fold.train
    if wrong:
        finite_or_refused(name, data, fold, tmp_path)
    else:
        assert len(trained(name, data, fold, tmp_path)) == len(fold.test)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize("name", UPLINK)
def test_methods_of_the_uplink_stay_finite_or_refuse(tmp_path, name, wrong):
    root = copytree(cities.folder(), tmp_path / "city")
    if wrong:
        csi = np.load(root / "csidata.npy")
        csi[7] *= 1e8
        np.save(root / "csidata.npy", csi)
        (root / "csidata-64.npy").unlink()
    data = load_argos(root, positions="true")
    if wrong:
        finite_or_refused(name, data, cities.fold(), tmp_path)
    else:
        assert len(trained(name, data, cities.fold(), tmp_path)) == len(cities.fold().test)


def test_no_method_is_forgotten():
    here = {name for names in (*QUICK.values(), UPLINK, *(cut[2] for cut in SLOW.values())) for name in names}
    assert here | {"calibrated_raytracer"} == set(methods())  # it needs a scene: tests/peers
