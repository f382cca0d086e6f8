"""`gsparc view`: what it writes, and what it refuses in one line."""

from dataclasses import replace

import numpy as np
import pytest
from campaigns import compose
from towns import town_model

from gsparc.apps.view.building import GAUSSIANS, build_scene, open_model
from gsparc.base.errors import DataError
from gsparc.commands import view as command
from gsparc.models import checkpoint
from gsparc.prediction.levels import predict_levels


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A run folder, without Hydra."""
    monkeypatch.setattr("gsparc.runs.output.run_directory", lambda: tmp_path)
    return tmp_path


def view(here, checkpoint, *more):
    return command.task(compose(f"ckpt='{checkpoint}'", *more, config="view"))


def test_splats_do_without_viser(here, monkeypatch, spectrum_view):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    facts = view(here, spectrum_view.viewed.name, f"save='{here / 'g.ply'}'")
    assert b"element vertex 40" in (here / "g.ply").read_bytes() and facts["model/name"] == "gsparc"


@pytest.mark.parametrize("more", [[], ["save=page.html"]])
def test_without_viser_one_line_says_what_to_install(here, monkeypatch, more):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"pip install 'gsparc\[viewer\]'"):
        view(here, here / "missing.ckpt", *more)


@pytest.mark.parametrize(
    "more, said",
    [
        (["save=scene.png"], "expected a name that ends with .html, .ply"),
        (["port=70000"], "at least 0 and at most 65535"),
        (["save=a.ply", "station=nowhere"], "there are east, west"),
        (["save=a.ply", "at=[1,2]"], "three finite numbers"),
        (["save=a.ply"], "holds no Gaussians to write"),
    ],
)
def test_what_cannot_be_is_said_and_nothing_is_written(here, monkeypatch, more, said):
    monkeypatch.chdir(here)
    with pytest.raises(DataError, match=said):
        view(here, town_model(), *more)
    assert not [file for file in here.iterdir() if file.suffix in (".ply", ".html")]


def test_a_model_whose_data_are_gone_is_shown_without_them(tmp_path):
    viewed = open_model(town_model(), {"file": str(tmp_path / "gone.npz")})
    assert viewed.data is None and "measured points are not drawn" in viewed.notes[0]
    scene = build_scene(viewed, None, "west", viewed.measured_at("west"))
    assert {part.name for part in scene.parts} == {
        "station west",
        "station east",
        "box of measurements",
    }


def test_powers_in_dbm_were_shown_in_db_by_default(monkeypatch):
    read = checkpoint.read
    monkeypatch.setattr(checkpoint, "read", lambda path: in_dbm(read(path)))
    given = compose("ckpt=x", config="view").unit
    viewed = open_model(town_model(), {"file": "gone.npz"}, "west", given)
    assert viewed.site.level_unit == "dBm"


def test_a_unit_of_pictures_changed_their_names_alone(monkeypatch):
    """`unit=dBW` of levels in dBm wrote dBW beside the same numbers."""
    read, places = checkpoint.read, np.array([[20.0, 30, 1.5], [50, 10, 1.5]])
    monkeypatch.setattr(checkpoint, "read", lambda path: in_dbm(read(path)))
    dbm, dbw = (open_model(town_model(), unit=unit) for unit in (None, "dBW"))
    assert (dbm.site.level_unit, dbw.site.level_unit) == ("dBm", "dBW")
    level, lower = (predict_levels(one.predictor_of("west"), places)[0] for one in (dbm, dbw))
    np.testing.assert_allclose(lower, level - 30, atol=1e-4)
    np.testing.assert_allclose(
        dbw.measured_at("west").values, dbm.measured_at("west").values - 30, atol=1e-4
    )
    with pytest.raises(ValueError, match=r"unit=mW: of powers in dBm expected dBm, dBW$"):
        open_model(town_model(), unit="mW")


def in_dbm(stored):
    return replace(stored, site=replace(stored.site, level_unit="dBm"))


def test_rendered_gaussians_are_drawn_where_they_lie(spectrum_view):
    scene = spectrum_view.station(None).scene
    gaussians = spectrum_view.viewed.predictor.method.fitted_model().gaussians
    origin = spectrum_view.viewed.site.origin
    drawn = scene.part(GAUSSIANS)
    np.testing.assert_allclose(drawn.places, gaussians.means.detach().numpy() + origin, atol=1e-6)
    assert len(np.unique(drawn.colours, axis=0)) > 5
