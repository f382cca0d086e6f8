"""A comparison of what was fetched: it needs no path."""

import shutil

from campaigns import compose
from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from refusals import refused
from releases import real

from gsparc.runs.experiment.cells import load_every_problem
from gsparc.runs.settings import to_dict

ROOM = "dataset_conference_ch1_rt_image_fc.pkl"


def test_a_fetched_set_needs_no_path(monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    settings = to_dict(compose("experiment=results/newrf", config="compare"))
    refused("no dataset has a path", load_every_problem, settings)
    (tmp_path / "gsparc/data/newrf").mkdir(parents=True)
    shutil.copy(real(f"releases/newrf/{ROOM}"), tmp_path / "gsparc/data/newrf")
    GlobalHydra.instance().clear()
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        problems = load_every_problem(settings)
    assert [one.split for one in problems] == ["redrawn"] * 10
    assert {one.draw for one in problems} == set(range(10)) and len(problems[0].data) == 433
    assert "or gsparc data" in caplog.text  # of the other sets
